"""Uploads that are refused: a stable reason, nothing left behind, and the next good one works."""

from __future__ import annotations

import errno
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import anyio
import pytest

from regnf_core.importing.containers.sniff import HEAD_BYTES
from regnf_state.blobs.base import StorageFullError, StorageUnavailableError
from tests.contract.bad_input import GOOD, PNG, PUT_GOOD, TOO_LARGE, announced
from tests.contract.world import World, assert_refused, field_bytes, sha256

pytestmark = pytest.mark.usefixtures("nothing_of_an_upload_stays")
LEGACY_TAR = b"sys_info".ljust(257, b"\0") + b"ustar\0" + b"\0" * 600


@pytest.mark.parametrize(
    ("method", "path", "content", "headers", "status", "reason"),
    [
        pytest.param("PUT", f"/fields/{sha256(b'')}", b"", {}, 400, "UPLOAD_INCOMPLETE", id="empty"),
        pytest.param("PUT", f"/fields/{sha256(b'x')}", b"x", {}, 415, "FIELD_NOT_RECOGNIZED", id="one byte"),
        pytest.param(
            "PUT", f"/fields/{sha256(TOO_LARGE)}", TOO_LARGE, {}, 413, "UPLOAD_TOO_LARGE", id="too large by its header"
        ),
        pytest.param(
            "PUT", PUT_GOOD, field_bytes("another"), {}, 400, "DIGEST_MISMATCH", id="under another file's hash"
        ),
        pytest.param(
            "PUT", PUT_GOOD, GOOD, {"Content-Digest": announced(b"x")}, 400, "DIGEST_MISMATCH", id="digest mismatch"
        ),
        pytest.param(
            "PUT",
            PUT_GOOD,
            GOOD,
            {"Content-Digest": "sha-256=:AAAA:"},
            400,
            "INVALID_DIGEST",
            id="digest of the wrong length",
        ),
        pytest.param(
            "PUT", PUT_GOOD, GOOD, {"Content-Digest": "sha-256=0000"}, 400, "INVALID_DIGEST", id="malformed digest"
        ),
        pytest.param("PUT", PUT_GOOD, GOOD, {"Content-Encoding": "gzip"}, 415, "UNSUPPORTED_MEDIA_TYPE", id="gzip"),
        pytest.param(
            "PUT",
            PUT_GOOD,
            GOOD,
            {"Content-Type": "multipart/form-data; boundary=x"},
            415,
            "UNSUPPORTED_MEDIA_TYPE",
            id="multipart for one file",
        ),
        pytest.param(
            "PUT",
            PUT_GOOD,
            GOOD,
            {"Content-Length": str(len(GOOD) + 1)},
            400,
            "UPLOAD_INCOMPLETE",
            id="shorter than declared",
        ),
        pytest.param(
            "PUT",
            PUT_GOOD,
            GOOD,
            {"Content-Length": str(len(GOOD) - 1)},
            400,
            "UPLOAD_INCOMPLETE",
            id="longer than declared",
        ),
        pytest.param("PUT", PUT_GOOD, GOOD, {"Content-Length": "0x10"}, 400, "INVALID_HEADER", id="malformed length"),
        pytest.param(
            "PUT", PUT_GOOD.upper().replace("FIELDS", "fields"), GOOD, {}, 400, "INVALID_DIGEST", id="upper-case hash"
        ),
        pytest.param("PUT", "/fields/abc", GOOD, {}, 400, "INVALID_DIGEST", id="a hash too short"),
        pytest.param("PUT", f"/fields/{'0' * 4096}", GOOD, {}, 400, "INVALID_DIGEST", id="a hash of 4 kB"),
        pytest.param("PUT", "/fields/%00", GOOD, {}, 400, "INVALID_DIGEST", id="NUL for a hash"),
        pytest.param("PUT", "/fields/%E2%80%AE", GOOD, {}, 400, "INVALID_DIGEST", id="RTL for a hash"),
        pytest.param("PUT", "/fields/..%2f..%2fetc", GOOD, {}, 404, "NOT_FOUND", id="encoded traversal for a hash"),
        pytest.param("POST", "/fields", PNG, {}, 415, "FIELD_NOT_RECOGNIZED", id="PNG"),
        pytest.param("POST", "/fields", LEGACY_TAR, {}, 415, "FIELD_NOT_RECOGNIZED", id="legacy tar"),
        pytest.param(
            "POST",
            "/fields",
            GOOD,
            {"Content-Digest": announced(b"x")},
            400,
            "DIGEST_MISMATCH",
            id="digest mismatch without a name",
        ),
        pytest.param(
            "POST",
            "/fields",
            GOOD,
            {"Content-Type": "multipart/form-data"},
            400,
            "MALFORMED_MULTIPART",
            id="no boundary",
        ),
        pytest.param(
            "POST",
            "/fields",
            GOOD,
            {"Content-Type": "multipart/form-data; boundary=x"},
            400,
            "MALFORMED_MULTIPART",
            id="no parts",
        ),
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
    begun = PNG.ljust(HEAD_BYTES, b"\0")

    def pieces() -> Iterator[bytes]:
        for piece in (begun, b"rest"):
            sent.append(piece)
            yield piece

    assert_refused(world.client.post("/fields", content=pieces()), 415, "FIELD_NOT_RECOGNIZED")
    assert sent == [begun]


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
            "headers": [(b"host", b"localhost"), *(headers or [])],
            "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 2),
        }  # fmt: skip
        await app(scope, receive, send)

    anyio.run(call)
    return sent[0]["status"], json.loads(b"".join(message.get("body", b"") for message in sent[1:]))


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


def test_two_uploads_of_one_hash_at_once_are_one_field(world: World) -> None:
    from concurrent.futures import ThreadPoolExecutor

    def slowly() -> Iterator[bytes]:
        for start in range(0, len(GOOD), 100):
            time.sleep(0.001)
            yield GOOD[start : start + 100]

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: world.client.put(PUT_GOOD, content=slowly()).status_code, range(8)))
    assert sorted(answers) == [200] * 7 + [201]
    assert world.queue.imports == [(sha256(GOOD), 1)]
    assert world.blobs.blobs == {f"fields/{sha256(GOOD)}/original": GOOD}
    assert world.client.delete(PUT_GOOD).status_code == 204
