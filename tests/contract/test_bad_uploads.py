"""Uploads that are refused: a stable reason, nothing left behind, and the next good one works."""

from __future__ import annotations

import base64
import errno
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import anyio
import pytest

from service.blobs import StorageFullError
from tests.contract.world import World, assert_refused, field_bytes, make_world, sha256

GOOD = field_bytes("good")
PUT_GOOD = f"/fields/{sha256(GOOD)}"
TOO_LARGE = field_bytes("large", 4097)
LEGACY_TAR = b"sys_info".ljust(257, b"\0") + b"ustar\0" + b"\0" * 600
PNG = b"\x89PNG\r\n\x1a\n" + b"\0" * 600
PLAIN_ZIP = b"PK\x03\x04" + b"\0" * 22 + b"\x09\0\0\0" + b"notes.txt" + b"\0" * 600


@pytest.fixture(autouse=True)
def _nothing_stays_and_the_next_works(world: World) -> Iterator[None]:
    yield
    assert world.blobs.blobs == {}
    assert world.records.list_fields(None, 10, None) == []
    assert world.client.put(PUT_GOOD, content=GOOD).status_code == 201


def announced(data: bytes) -> str:
    return f"sha-256=:{base64.b64encode(bytes.fromhex(sha256(data))).decode()}:"


@pytest.mark.parametrize(
    ("method", "path", "content", "headers", "status", "reason"),
    [
        ("PUT", f"/fields/{sha256(b'')}", b"", {}, 400, "UPLOAD_EMPTY"),
        ("PUT", f"/fields/{sha256(b'x')}", b"x", {}, 415, "FIELD_NOT_RECOGNISED"),
        ("PUT", f"/fields/{sha256(TOO_LARGE)}", TOO_LARGE, {}, 413, "UPLOAD_TOO_LARGE"),
        ("PUT", PUT_GOOD, field_bytes("another"), {}, 400, "DIGEST_MISMATCH"),
        ("PUT", PUT_GOOD, GOOD, {"Content-Digest": announced(b"x")}, 400, "DIGEST_MISMATCH"),
        ("PUT", PUT_GOOD, GOOD, {"Content-Digest": "sha-256=:AAAA:"}, 400, "INVALID_DIGEST"),
        ("PUT", PUT_GOOD, GOOD, {"Content-Digest": "sha-256=0000"}, 400, "INVALID_DIGEST"),
        ("PUT", PUT_GOOD, GOOD, {"Content-Encoding": "gzip"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
        ("PUT", PUT_GOOD, GOOD, {"Content-Type": "multipart/form-data; boundary=x"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
        ("PUT", PUT_GOOD, GOOD, {"Content-Length": str(len(GOOD) + 1)}, 400, "UPLOAD_INCOMPLETE"),
        ("PUT", PUT_GOOD, GOOD, {"Content-Length": str(len(GOOD) - 1)}, 400, "UPLOAD_INCOMPLETE"),
        ("PUT", PUT_GOOD, GOOD, {"Content-Length": "0x10"}, 400, "INVALID_HEADER"),
        ("PUT", PUT_GOOD.upper().replace("FIELDS", "fields"), GOOD, {}, 400, "INVALID_DIGEST"),
        ("PUT", "/fields/abc", GOOD, {}, 400, "INVALID_DIGEST"),
        ("PUT", f"/fields/{'0' * 4096}", GOOD, {}, 400, "INVALID_DIGEST"),
        ("PUT", "/fields/%00", GOOD, {}, 400, "INVALID_DIGEST"),
        ("PUT", "/fields/%E2%80%AE", GOOD, {}, 400, "INVALID_DIGEST"),
        ("PUT", "/fields/..%2f..%2fetc", GOOD, {}, 404, "NOT_FOUND"),
        ("POST", "/fields", PNG, {}, 415, "FIELD_NOT_RECOGNISED"),
        ("POST", "/fields", LEGACY_TAR, {}, 415, "FIELD_NOT_RECOGNISED"),
        ("POST", "/fields", PLAIN_ZIP, {}, 415, "FIELD_NOT_RECOGNISED"),
        ("POST", "/fields", GOOD, {"Content-Digest": announced(b"x")}, 400, "DIGEST_MISMATCH"),
        ("POST", "/fields", GOOD, {"Content-Type": "multipart/form-data"}, 400, "MALFORMED_MULTIPART"),
        ("POST", "/fields", GOOD, {"Content-Type": "multipart/form-data; boundary=x"}, 400, "MALFORMED_MULTIPART"),
    ],
)
def test_refused(
    world: World, method: str, path: str, content: bytes, headers: dict[str, str], status: int, reason: str
) -> None:
    assert_refused(world.client.request(method, path, content=content, headers=headers), status, reason)


def test_too_large_is_noticed_by_count(world: World) -> None:
    pieces = (TOO_LARGE[start : start + 512] for start in range(0, len(TOO_LARGE), 512))
    assert_refused(world.client.post("/fields", content=pieces), 413, "UPLOAD_TOO_LARGE")


def test_an_unknown_kind_is_refused_before_the_rest_is_sent(world: World) -> None:
    sent = []

    def pieces() -> Iterator[bytes]:
        for piece in (PNG, b"rest"):
            sent.append(piece)
            yield piece

    assert_refused(world.client.post("/fields", content=pieces()), 415, "FIELD_NOT_RECOGNISED")
    assert sent == [PNG]


def part(name: str, data: bytes, file: bool = False) -> bytes:
    kind = f'form-data; name="{name}"' + ('; filename="f"' if file else "")
    return f"--x\r\nContent-Disposition: {kind}\r\n\r\n".encode() + data + b"\r\n"


FILE = part("file", GOOD, file=True)


@pytest.mark.parametrize(
    ("body", "status", "reason"),
    [
        (b"".join(part(f"p{i}", b"") for i in range(100)), 400, "UNKNOWN_PART"),
        (FILE + FILE, 400, "DUPLICATE_PART"),
        (FILE + part("description", b"{}") * 2, 400, "DUPLICATE_PART"),
        (part("description", b" " * 20_000) + FILE, 413, "REQUEST_TOO_LARGE"),
        (part("description", b"{}"), 400, "MISSING_PART"),
        (part("file", b"", file=True), 400, "UPLOAD_EMPTY"),
        (part("file", TOO_LARGE, file=True), 413, "UPLOAD_TOO_LARGE"),
        (part("file", PNG, file=True), 415, "FIELD_NOT_RECOGNISED"),
        (FILE + part("description", b'{"label": 5}'), 422, "INVALID_DESCRIPTION"),
        (FILE + part("description", b'{"unknown": 5}'), 422, "INVALID_DESCRIPTION"),
        (FILE + part("description", b'{"level_mask": true}'), 422, "INVALID_DESCRIPTION"),
        (FILE + part("description", b"{"), 400, "MALFORMED_JSON"),
        (FILE + part("description", json.dumps({"label": "\ud800"}).encode()), 400, "MALFORMED_JSON"),
        (b"--x\r\nContent-Disposition: form-data\r\n\r\nx\r\n", 400, "UNKNOWN_PART"),
        (b"--x\r\n" + b"X: y\r\n" * 20 + b"\r\nx\r\n", 400, "MALFORMED_MULTIPART"),
        (b"--x\r\nX: " + b"y" * 9000 + b"\r\n\r\nx\r\n", 400, "MALFORMED_MULTIPART"),
        (
            b'--x\r\nContent-Disposition: form-data; name="file"\r\nContent-Transfer-Encoding: base64\r\n\r\nAA\r\n',
            400,
            "MALFORMED_MULTIPART",
        ),
    ],
)
def test_multipart_refused(world: World, body: bytes, status: int, reason: str) -> None:
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    assert_refused(world.client.post("/fields", content=body + b"--x--\r\n", headers=headers), status, reason)


def test_a_digest_of_a_multipart_body_is_compared_with_all_of_it(world: World) -> None:
    headers = {"Content-Type": "multipart/form-data; boundary=x", "Content-Digest": announced(GOOD)}
    whole = FILE + b"--x--\r\n"
    assert_refused(world.client.post("/fields", content=whole, headers=headers), 400, "DIGEST_MISMATCH")
    assert list(world.blobs.list("")) == []
    headers["Content-Digest"] = announced(whole)
    taken = world.client.post("/fields", content=whole, headers=headers)
    assert taken.status_code == 201
    assert world.client.delete(taken.json()["links"]["self"]).status_code == 204


@pytest.mark.parametrize("reason", ["UNKNOWN_PART", "DUPLICATE_PART"])
def test_a_thousand_parts_are_refused_at_the_first_odd_one(tmp_path: Any, reason: str) -> None:
    world = make_world(tmp_path, max_upload_bytes=1 << 20)
    name = "p" if reason == "UNKNOWN_PART" else "description"
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    body = part(name, b"{}") * 1001 + b"--x--\r\n"
    assert_refused(world.client.post("/fields", content=body, headers=headers), 400, reason)
    world.client.close()


def test_multipart_that_breaks_off_is_refused(world: World) -> None:
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    assert_refused(world.client.post("/fields", content=FILE, headers=headers), 400, "MALFORMED_MULTIPART")


def test_a_boundary_continued_beyond_all_counting_is_refused(world: World) -> None:
    headers = {"Content-Type": f"multipart/form-data; boundary*{'9' * 5000}=x"}
    assert_refused(world.client.post("/fields", content=b"x", headers=headers), 400, "MALFORMED_MULTIPART")


@pytest.mark.parametrize("boundary", ["y" * 71, "", '"'])
def test_boundaries_that_cannot_be_used_are_refused(world: World, boundary: str) -> None:
    headers = {"Content-Type": f"multipart/form-data; boundary={boundary}"}
    assert_refused(world.client.post("/fields", content=FILE, headers=headers), 400, "MALFORMED_MULTIPART")


def raw_call(app: Any, messages: list[dict[str, Any]], headers: list[tuple[bytes, bytes]] | None = None) -> Any:
    """PUT the good field with these ASGI messages, then silence; (status, body) of the answer."""
    sent: list[dict[str, Any]] = []

    async def call() -> None:
        left = iter(messages)

        async def receive() -> dict[str, Any]:
            message = next(left, None)
            if message is None:
                await anyio.sleep_forever()
            assert message is not None
            return message

        async def send(message: dict[str, Any]) -> None:
            sent.append(message)

        scope = {
            "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "PUT", "scheme": "http",
            "path": PUT_GOOD, "raw_path": PUT_GOOD.encode(), "query_string": b"", "root_path": "",
            "headers": headers or [], "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 2),
        }  # fmt: skip
        await app(scope, receive, send)

    anyio.run(call)
    return sent[0]["status"], json.loads(b"".join(message.get("body", b"") for message in sent[1:]))


def test_a_client_that_stalls_is_told_and_forgotten(world: World, tmp_path: Any) -> None:
    slow = make_world(tmp_path, upload_stall_s=0.05)
    status, problem = raw_call(slow.app, [{"type": "http.request", "body": GOOD[:100], "more_body": True}])
    assert (status, problem["reason"]) == (408, "UPLOAD_STALLED")
    assert slow.blobs.blobs == {}
    slow.client.close()


def test_aborted_uploads_leave_nothing(tmp_path: Any) -> None:
    from service.local_blobs import LocalBlobStore

    world = make_world(tmp_path)
    store = LocalBlobStore(tmp_path / "blobs")
    object.__setattr__(world.app.state.services, "blobs", store)
    messages: list[dict[str, Any]] = [
        {"type": "http.request", "body": GOOD[:300], "more_body": True},
        {"type": "http.disconnect"},
    ]
    for _ in range(50):
        status, problem = raw_call(world.app, messages)
        assert (status, problem["reason"]) == (400, "UPLOAD_INCOMPLETE")
    assert [path for path in (tmp_path / "blobs").rglob("*") if path.is_file()] == []
    world.client.close()


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (StorageFullError(errno.ENOSPC, "full"), 507, "STORAGE_FULL"),
        (OSError(errno.EIO, "broken"), 503, "STORAGE_UNAVAILABLE"),
    ],
)
def test_storage_that_fails_keeps_nothing(
    world: World, monkeypatch: pytest.MonkeyPatch, error: OSError, status: int, reason: str
) -> None:
    class Failing:
        def write(self, data: bytes) -> int:
            raise error

        def commit(self, key: str) -> None:
            raise AssertionError("nothing to commit")

    @contextmanager
    def writer() -> Iterator[Failing]:
        yield Failing()

    with monkeypatch.context() as patch:
        patch.setattr(world.blobs, "writer", writer)
        answer = world.client.put(PUT_GOOD, content=GOOD)
    assert_refused(answer, status, reason)
    assert int(answer.headers["retry-after"]) > 0


def test_two_uploads_of_one_hash_at_once_are_one_field(tmp_path: Any) -> None:
    from concurrent.futures import ThreadPoolExecutor

    world = make_world(tmp_path)

    def slowly() -> Iterator[bytes]:
        for start in range(0, len(GOOD), 100):
            time.sleep(0.001)
            yield GOOD[start : start + 100]

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: world.client.put(PUT_GOOD, content=slowly()).status_code, range(8)))
    assert sorted(answers) == [200] * 7 + [201]
    assert world.queue.imports == [(sha256(GOOD), 1)]
    assert world.blobs.blobs == {f"fields/{sha256(GOOD)}/original": GOOD}
    world.client.close()
