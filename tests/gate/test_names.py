"""Odd names, wherever a client may give one: they name nothing on the service's side."""

from __future__ import annotations

import json

import pytest

from tests.contract.world import assert_refused, sha256
from tests.gate.house import House

FORM = {"Content-Type": "multipart/form-data; boundary=x"}
FILE_NAMES = {
    "../": b"../../etc/passwd",
    "absolute": b"/etc/passwd",
    "encoded traversal": b"..%2f..%2fetc",
    "NUL": b"a\0b",
    "CR/LF": b"a\r\nX-Bad: 1",
    "RTL": "\u202etpkc.room".encode(),
    "no text": b"\xff\xfe",
    "another part's name": b'a"; name="description',
    "just within 4 kB": b"n" * 4000,
}


def form(content: bytes, file_name: bytes, description: dict[str, str] | None = None) -> bytes:
    head = b'--x\r\nContent-Disposition: form-data; name="file"; filename="' + file_name + b'"\r\n\r\n'
    said = b""
    if description is not None:
        text = json.dumps(description).encode()
        said = b'--x\r\nContent-Disposition: form-data; name="description"\r\n\r\n' + text + b"\r\n"
    return head + content + b"\r\n" + said + b"--x--\r\n"


@pytest.mark.parametrize("row", FILE_NAMES)
def test_a_files_name_is_of_no_use(house: House, row: str) -> None:
    answer = house.world.client.post("/fields", content=form(house.good, FILE_NAMES[row]), headers=FORM)
    assert answer.status_code == 201
    assert "x-bad" not in answer.headers
    assert list(house.world.blobs.blobs) == [f"fields/{sha256(house.good)}/original"]
    assert house.imported(answer) == "ready"
    assert house.world.client.delete(answer.json()["links"]["self"]).status_code == 204


def test_a_files_name_beyond_4_kb_is_refused(house: House) -> None:
    answer = house.world.client.post("/fields", content=form(house.good, b"n" * 5000), headers=FORM)
    assert_refused(answer, 400, "MALFORMED_MULTIPART")


LABELS = {"NUL": "a\0b", "CR/LF": "a\r\nX-Bad: 1", "newline": "a\n", "RTL": "a\u202eb", "4 kB": "x" * 4096}


@pytest.mark.parametrize("row", LABELS)
def test_odd_labels_of_fields_are_refused(house: House, row: str) -> None:
    answer = house.world.client.post("/fields", content=form(house.good, b"f", {"label": LABELS[row]}), headers=FORM)
    problem = assert_refused(answer, 422, "INVALID_DESCRIPTION")
    assert [entry["pointer"] for entry in problem["errors"]] == ["/label"]
