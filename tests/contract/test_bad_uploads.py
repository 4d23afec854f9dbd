"""Uploads that are refused: a stable reason, nothing left behind, and the next good one works."""

from __future__ import annotations

import errno
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import Mock

import httpx
import pytest

from regnf_core.importing.containers.sniff import HEAD_BYTES
from regnf_service.fields.uploads import Upload
from regnf_service.http.body import _Collector
from regnf_state.blobs.base import StorageFullError, StorageUnavailableError
from tests.contract.conftest import GOOD, PNG, PUT_GOOD, TOO_LARGE, announced
from tests.contract.world import World, assert_refused, field_bytes, make_world, sha256

pytestmark = pytest.mark.usefixtures("nothing_of_an_upload_stays")
LEGACY_TAR = b"sys_info".ljust(257, b"\0") + b"ustar\0" + b"\0" * 600
IN_PARTS = {"Content-Type": "multipart/form-data; boundary=x"}

PUTS: list[tuple[str, bytes, dict[str, str], int, str]] = [
    (f"/fields/{sha256(b'x')}", b"x", {}, 415, "FIELD_NOT_RECOGNIZED"),
    (f"/fields/{sha256(TOO_LARGE)}", TOO_LARGE, {}, 413, "UPLOAD_TOO_LARGE"),
    (PUT_GOOD, field_bytes("another"), {}, 400, "DIGEST_MISMATCH"),
    (PUT_GOOD, GOOD, {"Content-Digest": announced(b"x")}, 400, "DIGEST_MISMATCH"),
    (PUT_GOOD, GOOD, {"Content-Digest": "sha-256=:AAAA:"}, 400, "INVALID_DIGEST"),
    (PUT_GOOD, GOOD, {"Content-Digest": "sha-256=0000"}, 400, "INVALID_DIGEST"),
    (PUT_GOOD, GOOD, {"Content-Encoding": "gzip"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
    (PUT_GOOD, GOOD, IN_PARTS, 415, "UNSUPPORTED_MEDIA_TYPE"),
    (PUT_GOOD, GOOD, {"Content-Length": str(len(GOOD) + 1)}, 400, "UPLOAD_INCOMPLETE"),
    (PUT_GOOD, GOOD, {"Content-Length": str(len(GOOD) - 1)}, 400, "UPLOAD_INCOMPLETE"),
    (PUT_GOOD, GOOD, {"Content-Length": "0x10"}, 400, "INVALID_HEADER"),
    (PUT_GOOD.upper().replace("FIELDS", "fields"), GOOD, {}, 400, "INVALID_DIGEST"),
    *((f"/fields/{name}", GOOD, {}, 400, "INVALID_DIGEST") for name in ("abc", "0" * 4096, "%00", "%E2%80%AE")),
    ("/fields/..%2f..%2fetc", GOOD, {}, 404, "NOT_FOUND"),
]
POSTS: list[tuple[str, bytes, dict[str, str], int, str]] = [
    ("/fields", LEGACY_TAR, {}, 415, "FIELD_NOT_RECOGNIZED"),
    ("/fields", GOOD, {"Content-Digest": announced(b"x")}, 400, "DIGEST_MISMATCH"),
    ("/fields", GOOD, IN_PARTS, 400, "MALFORMED_MULTIPART"),
]


@pytest.mark.parametrize(("method", "cases"), [("PUT", PUTS), ("POST", POSTS)], ids=["PUT", "POST"])
def test_refused(world: World, method: str, cases: list[tuple[str, bytes, dict[str, str], int, str]]) -> None:
    for path, content, headers, status, reason in cases:
        assert_refused(world.client.request(method, path, content=content, headers=headers), status, reason)
        assert world.blobs.blobs == {}, (path, headers)


def test_too_large_is_noticed_by_count(world: World) -> None:
    pieces = (TOO_LARGE[start : start + 512] for start in range(0, len(TOO_LARGE), 512))
    assert_refused(world.client.post("/fields", content=pieces), 413, "UPLOAD_TOO_LARGE")


def test_an_unknown_kind_is_refused_before_the_rest_is_sent(world: World) -> None:
    sent = []
    begun = PNG.ljust(HEAD_BYTES, b"\0")

    def pieces() -> Iterator[bytes]:
        for piece in (begun, b"rest"):
            sent.append(piece)
            yield piece

    assert_refused(world.client.post("/fields", content=pieces()), 415, "FIELD_NOT_RECOGNIZED")
    assert sent == [begun]


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (StorageFullError(errno.ENOSPC, "full"), 507, "STORAGE_FULL"),
        (OSError(errno.EIO, "broken"), 503, "STORAGE_UNAVAILABLE"),
        (StorageUnavailableError(errno.ENODEV, "away"), 503, "STORAGE_UNAVAILABLE"),
    ],
)
def test_storage_that_fails_keeps_nothing(
    world: World, monkeypatch: pytest.MonkeyPatch, error: OSError, status: int, reason: str
) -> None:
    failing = Mock(**{"return_value.write.side_effect": error, "return_value.commit.side_effect": AssertionError})
    with monkeypatch.context() as patch:
        patch.setattr(world.blobs, "writer", contextmanager(lambda: iter([failing()])))
        answer = world.client.put(PUT_GOOD, content=GOOD)
    assert_refused(answer, status, reason)
    assert int(answer.headers["retry-after"]) > 0


# in parts


def part(name: str, data: bytes, file: bool = False) -> bytes:
    kind = f'form-data; name="{name}"' + ('; filename="f"' if file else "")
    return f"--x\r\nContent-Disposition: {kind}\r\n\r\n".encode() + data + b"\r\n"


FILE = part("file", GOOD, file=True)
END = b"--x--\r\n"


def described(text: bytes) -> bytes:
    return FILE + part("description", text)


def send(world: World, body: bytes, **headers: str) -> httpx.Response:
    return world.client.post("/fields", content=body, headers=IN_PARTS | headers)


BODIES: dict[str, tuple[int, list[bytes]]] = {
    "MALFORMED_MULTIPART": (400, [
        b"".join(part(f"p{i}", b"") for i in range(100)),
        b"--x\r\nContent-Disposition: form-data\r\n\r\nx\r\n",
        part("description", b"{}"),
        b'--x\r\nContent-Disposition: form-data; name="file"' + b";" * 2000 + b"\r\n\r\n",
            FILE + FILE, described(b"{}") + part("description", b"{}"), b"--x\r\n" + b"X: y\r\n" * 20 + b"\r\nx\r\n",
        b"--x\r\nX: " + b"y" * 9000 + b"\r\n\r\nx\r\n",
        b'--x\r\nContent-Disposition: form-data; name="file"\r\nContent-Transfer-Encoding: base64\r\n\r\nAA\r\n',
    ]),
    "UPLOAD_INCOMPLETE": (400, [part("file", b"", file=True)]),
    "UPLOAD_TOO_LARGE": (413, [part("file", TOO_LARGE, file=True)]),
    "FIELD_NOT_RECOGNIZED": (415, [part("file", PNG, file=True)]),
    "INVALID_DESCRIPTION": (422, [described(text) for text in (b'{"label": 5}', b'{"unknown": 5}',
    b'{"level_mask": true}')]),
    "MALFORMED_JSON": (400, [described(b"{"), described(json.dumps({"label": "\ud800"}).encode())]),
    "REQUEST_TOO_LARGE": (413, [part("description", b" " * 20_000) + FILE]),
}  # fmt: skip


@pytest.mark.parametrize("reason", BODIES)
def test_bodies_in_parts(world: World, reason: str) -> None:
    status, bodies = BODIES[reason]
    for body in bodies:
        assert_refused(send(world, body + END), status, reason)


def test_a_text_part_one_byte_too_long_is_refused_by_its_name(world: World) -> None:
    for name, limit in (("upload", 272), ("description", 16384)):
        answer = send(world, part(name, b"a" * (limit + 1)) + END)
        problem = assert_refused(answer, 413, "REQUEST_TOO_LARGE")
        assert problem["detail"] == f"The part {name} can have at most {limit} bytes."


def test_a_digest_of_a_body_in_parts_is_compared_with_all_of_it(world: World) -> None:
    whole = FILE + END
    assert_refused(send(world, whole, **{"Content-Digest": announced(GOOD)}), 400, "DIGEST_MISMATCH")
    assert world.blobs.blobs == {}
    taken = send(world, whole, **{"Content-Digest": announced(whole)})
    assert taken.status_code == 201
    assert world.client.delete(taken.json()["links"]["self"]).status_code == 204


def test_a_thousand_parts_are_refused_at_the_first_odd_one(world: World, tmp_path: Any, any_redis: Any) -> None:
    large = make_world(tmp_path, any_redis, max_upload_bytes=1 << 20)
    for name in ("p", "description"):
        assert_refused(send(large, part(name, b"{}") * 1001 + END), 400, "MALFORMED_MULTIPART")
    large.client.close()


def test_boundaries(world: World) -> None:
    """Breaks off before it, continued beyond all counting, with thousands of parameters, or none that can be used."""
    assert_refused(send(world, FILE), 400, "MALFORMED_MULTIPART")
    for kind in (f"*{'9' * 5000}=x", "=x" + ";" * 8000, f"={'y' * 71}", "=", '="'):
        answer = send(world, FILE + END, **{"Content-Type": f"multipart/form-data; boundary{kind}"})
        assert_refused(answer, 400, "MALFORMED_MULTIPART")


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
    answer = send(world, part("file", crumbs, file=True) + END)
    assert (answer.status_code, answer.json()["bytes"]) == (201, len(crumbs))
    assert len(pieces) <= 2
    assert all("AnyIO worker" in name for name in threads), "not on the event loop, where everybody would wait"
    assert world.client.delete(answer.json()["links"]["self"]).status_code == 204
