"""Multipart bodies that are refused: a stable reason, nothing left behind, and the next good upload works."""

from __future__ import annotations

import json
import threading
from typing import Any

import pytest

from regnf_service.fields.uploads import Upload
from regnf_service.http.body import _Collector
from tests.contract.bad_input import GOOD, PNG, TOO_LARGE, announced
from tests.contract.world import World, assert_refused, make_world

pytestmark = pytest.mark.usefixtures("nothing_of_an_upload_stays")


def part(name: str, data: bytes, file: bool = False) -> bytes:
    kind = f'form-data; name="{name}"' + ('; filename="f"' if file else "")
    return f"--x\r\nContent-Disposition: {kind}\r\n\r\n".encode() + data + b"\r\n"


FILE = part("file", GOOD, file=True)


@pytest.mark.parametrize(
    ("body", "status", "reason"),
    [
        pytest.param(
            b"".join(part(f"p{i}", b"") for i in range(100)), 400, "MALFORMED_MULTIPART", id="a hundred parts"
        ),
        pytest.param(FILE + FILE, 400, "MALFORMED_MULTIPART", id="two files"),
        pytest.param(FILE + part("description", b"{}") * 2, 400, "MALFORMED_MULTIPART", id="duplicate names"),
        pytest.param(part("description", b" " * 20_000) + FILE, 413, "REQUEST_TOO_LARGE", id="a huge text field"),
        pytest.param(part("description", b"{}"), 400, "MALFORMED_MULTIPART", id="no file"),
        pytest.param(part("file", b"", file=True), 400, "UPLOAD_INCOMPLETE", id="an empty file"),
        pytest.param(part("file", TOO_LARGE, file=True), 413, "UPLOAD_TOO_LARGE", id="a file too large"),
        pytest.param(part("file", PNG, file=True), 415, "FIELD_NOT_RECOGNIZED", id="a PNG"),
        pytest.param(
            FILE + part("description", b'{"label": 5}'), 422, "INVALID_DESCRIPTION", id="a label that is no text"
        ),
        pytest.param(FILE + part("description", b'{"unknown": 5}'), 422, "INVALID_DESCRIPTION", id="unknown member"),
        pytest.param(
            FILE + part("description", b'{"level_mask": true}'), 422, "INVALID_DESCRIPTION", id="boolean for a number"
        ),
        pytest.param(FILE + part("description", b"{"), 400, "MALFORMED_JSON", id="bad JSON"),
        pytest.param(
            FILE + part("description", json.dumps({"label": "\ud800"}).encode()),
            400,
            "MALFORMED_JSON",
            id="half a surrogate pair",
        ),
        pytest.param(
            b"--x\r\nContent-Disposition: form-data\r\n\r\nx\r\n",
            400,
            "MALFORMED_MULTIPART",
            id="a part without a name",
        ),
        pytest.param(b"--x\r\n" + b"X: y\r\n" * 20 + b"\r\nx\r\n", 400, "MALFORMED_MULTIPART", id="twenty headers"),
        pytest.param(b"--x\r\nX: " + b"y" * 9000 + b"\r\n\r\nx\r\n", 400, "MALFORMED_MULTIPART", id="a huge header"),
        pytest.param(
            b'--x\r\nContent-Disposition: form-data; name="file"\r\nContent-Transfer-Encoding: base64\r\n\r\nAA\r\n',
            400,
            "MALFORMED_MULTIPART",
            id="base64",
        ),
    ],
)
def test_multipart_refused(world: World, body: bytes, status: int, reason: str) -> None:
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    assert_refused(world.client.post("/fields", content=body + b"--x--\r\n", headers=headers), status, reason)


@pytest.mark.parametrize(("name", "limit"), [("upload", 272), ("description", 16384)])
def test_a_text_part_one_byte_too_long_is_refused_by_its_name(world: World, name: str, limit: int) -> None:
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    answer = world.client.post("/fields", content=part(name, b"a" * (limit + 1)) + b"--x--\r\n", headers=headers)
    assert_refused(answer, 413, "REQUEST_TOO_LARGE")
    assert answer.json()["detail"] == f"The part {name} takes at most {limit} bytes."


def test_a_digest_of_a_multipart_body_is_compared_with_all_of_it(world: World) -> None:
    headers = {"Content-Type": "multipart/form-data; boundary=x", "Content-Digest": announced(GOOD)}
    whole = FILE + b"--x--\r\n"
    assert_refused(world.client.post("/fields", content=whole, headers=headers), 400, "DIGEST_MISMATCH")
    assert world.blobs.blobs == {}
    headers["Content-Digest"] = announced(whole)
    taken = world.client.post("/fields", content=whole, headers=headers)
    assert taken.status_code == 201
    assert world.client.delete(taken.json()["links"]["self"]).status_code == 204


@pytest.mark.parametrize("name", ["p", "description"])
def test_a_thousand_parts_are_refused_at_the_first_odd_one(tmp_path: Any, any_redis: Any, name: str) -> None:
    world = make_world(tmp_path, any_redis, max_upload_bytes=1 << 20)
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    body = part(name, b"{}") * 1001 + b"--x--\r\n"
    assert_refused(world.client.post("/fields", content=body, headers=headers), 400, "MALFORMED_MULTIPART")
    world.client.close()


def test_multipart_that_breaks_off_is_refused(world: World) -> None:
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    assert_refused(world.client.post("/fields", content=FILE, headers=headers), 400, "MALFORMED_MULTIPART")


def test_a_boundary_continued_beyond_all_counting_is_refused(world: World) -> None:
    headers = {"Content-Type": f"multipart/form-data; boundary*{'9' * 5000}=x"}
    assert_refused(world.client.post("/fields", content=b"x", headers=headers), 400, "MALFORMED_MULTIPART")


def test_headers_of_thousands_of_parameters_are_not_read(world: World) -> None:
    headers = {"Content-Type": "multipart/form-data; boundary=x" + ";" * 8000}
    assert_refused(world.client.post("/fields", content=FILE, headers=headers), 400, "MALFORMED_MULTIPART")
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    disposition = b'--x\r\nContent-Disposition: form-data; name="file"' + b";" * 2000
    answer = world.client.post("/fields", content=disposition + b"\r\n\r\n", headers=headers)
    assert_refused(answer, 400, "MALFORMED_MULTIPART")


@pytest.mark.parametrize("boundary", ["y" * 71, "", '"'])
def test_boundaries_that_cannot_be_used_are_refused(world: World, boundary: str) -> None:
    headers = {"Content-Type": f"multipart/form-data; boundary={boundary}"}
    assert_refused(world.client.post("/fields", content=FILE, headers=headers), 400, "MALFORMED_MULTIPART")


def test_what_is_nearly_a_boundary_is_not_handed_on_in_crumbs(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """A boundary of one character, and nearly that one in every few bytes: each would be an event of its own."""
    pieces: list[int] = []
    threads: set[str] = set()
    feed, parse = Upload.feed, _Collector.feed

    async def counted(upload: Upload, data: bytes | bytearray) -> None:
        pieces.append(len(data))
        await feed(upload, data)

    def watched(collector: _Collector, data: bytes) -> Any:
        threads.add(threading.current_thread().name)
        return parse(collector, data)

    monkeypatch.setattr(Upload, "feed", counted)
    monkeypatch.setattr(_Collector, "feed", watched)
    crumbs = GOOD + b"\r\n--xxy" * 300
    body = part("file", crumbs, file=True) + b"--x--\r\n"
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    answer = world.client.post("/fields", content=body, headers=headers)
    assert (answer.status_code, answer.json()["bytes"]) == (201, len(crumbs))
    assert len(pieces) <= 2
    assert all("AnyIO worker" in name for name in threads), "not on the event loop, where everybody would wait"
    assert world.client.delete(answer.json()["links"]["self"]).status_code == 204
