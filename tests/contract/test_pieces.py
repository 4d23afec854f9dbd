"""Uploads in pieces: what has arrived whole stays, and the upload goes on behind it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import Any

import httpx
import pytest

from regnf_core.importing.containers.sniff import HEAD_BYTES
from regnf_state.blobs.local import LocalBlobWriter
from regnf_state.pieces import Pieces
from tests.contract import world as contract
from tests.contract.conftest import announced
from tests.contract.world import ALICE, BOB, TOKENS, World, assert_refused, field_bytes, sha256

DATA = field_bytes("in pieces", 2000)
NAME = sha256(DATA)
ORIGINAL = f"fields/{NAME}/original"
WAIT = {"Upload-Complete": "?0"}
Worlds = Callable[..., World]


def put(
    world: World, first: int, end: int, data: bytes = DATA, sent: bytes | None = None, **headers: str
) -> httpx.Response:
    """Send bytes ``first`` to ``end`` - 1 of a file, or others than those."""
    content = data[first:end] if sent is None else sent
    span = {"Content-Range": f"bytes {first}-{end - 1}/{len(data)}"}
    return world.client.put(f"/fields/{sha256(data)}", content=content, headers=span | headers)


def ask(world: World, data: bytes = DATA, **headers: str) -> httpx.Response:
    span = {"Content-Range": f"bytes */{len(data)}"}
    return world.client.put(f"/fields/{sha256(data)}", content=b"", headers=span | headers)


def offset(world: World, data: bytes = DATA, **headers: str) -> int:
    return int(ask(world, data, **headers).json()["offset"])


def finish(world: World, name: str = NAME, **parts: Any) -> httpx.Response:
    """Ask for the field of the pieces that have come, in a request of 200 bytes."""
    return world.client.post("/fields", files={"upload": (None, name), **parts})


def test_pieces_make_the_field_that_the_whole_would_have_made(world: World) -> None:
    assert offset(world) == 0
    first = put(world, 0, 700)
    assert (first.status_code, first.headers["upload-offset"]) == (202, "700")
    assert first.json() == {"sha256": NAME, "offset": 700, "bytes": 2000}
    assert (ask(world).status_code, offset(world)) == (202, 700)
    assert world.client.get(f"/fields/{NAME}").status_code == 404
    assert put(world, 700, 1500).json()["offset"] == 1500
    last = put(world, 1500, 2000)
    assert (last.status_code, last.json()["state"], last.json()["bytes"]) == (201, "validating", 2000)
    assert (world.blobs.blobs, world.queue.imports) == ({ORIGINAL: DATA}, [(NAME, 1)])
    assert put(world, 1500, 2000).status_code == 200, "the last piece again is the field"
    assert ask(world).json()["sha256"] == NAME
    assert list(world.blobs.blobs) == [ORIGINAL]


def test_a_piece_that_is_no_next_one_is_refused_and_not_kept(world: World) -> None:
    put(world, 0, 700)
    for first in (0, 600, 701):
        answer = put(world, first, 1000)
        assert assert_refused(answer, 409, "UPLOAD_NOT_FINISHED")["offset"] == 700
        assert answer.headers["upload-offset"] == "700"
    assert_refused(put(world, 700, 2000, sent=DATA[700:1500]), 400, "UPLOAD_INCOMPLETE")
    assert_refused(put(world, 700, 1000, **{"Content-Digest": announced(DATA)}), 400, "DIGEST_MISMATCH")
    of_another = {"Content-Range": "bytes 700-1999/2400"}
    assert_refused(put(world, 700, 2000, **of_another), 400, "INVALID_HEADER")
    assert offset(world) == 700
    digest = {"Content-Digest": announced(DATA[700:1000])}
    assert put(world, 700, 1000, **digest).status_code == 202


def test_bytes_that_are_not_the_announced_ones_are_not_kept(world: World) -> None:
    put(world, 0, 700)
    assert_refused(put(world, 700, 2000, sent=DATA[:1300]), 400, "DIGEST_MISMATCH")
    assert world.blobs.blobs == {}
    assert offset(world) == 0


def test_a_file_that_is_no_field_is_refused_with_its_first_piece(worlds: Worlds) -> None:
    world = worlds(max_upload_bytes=4 * HEAD_BYTES)
    picture = b"\x89PNG\r\n\x1a\n" + b"\0" * 2 * HEAD_BYTES
    assert_refused(put(world, 0, HEAD_BYTES, picture), 415, "FIELD_NOT_RECOGNIZED")
    assert world.blobs.blobs == {}


def test_a_wrong_range_is_refused(world: World) -> None:
    wrong = {
        "INVALID_HEADER": (400, ["bytes 0-9", "bytes 9-0/2000", "bytes 0-2000/2000", "items 0-9/2000", "bytes 0-9/*",
                                 "bytes 0-9/9999999999999999", "bytes 0-9/2000", "bytes */2000"]),
        "UPLOAD_TOO_LARGE": (413, ["bytes 0-9/5000"]),
        "UPLOAD_INCOMPLETE": (400, ["bytes */0"]),
    }  # fmt: skip
    for reason, (status, spans) in wrong.items():
        for span in spans:
            assert_refused(put(world, 0, 700, **{"Content-Range": span}), status, reason)
    assert world.blobs.blobs == {}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_settings_go_with_pieces(world: World, encoding: str) -> None:
    put(world, 0, 700, **WAIT)
    assert put(world, 700, 2000, **WAIT).json()["offset"] == 2000
    said = json.dumps({"label": "room"}).encode(encoding)
    parts = {"description": (None, said, "application/json"), "settings": ("config.yml", b"method: neus")}
    answer = world.client.post("/fields", files={"upload": (None, f"{NAME}\r\n".encode(encoding)), **parts})
    assert answer.status_code == 201, answer.text
    assert (answer.json()["label"], answer.json()["settings"]["name"]) == ("room", "config.yml")
    assert world.blobs.blobs[ORIGINAL] == DATA
    assert not [key for key in world.blobs.blobs if key.startswith("uploads/")]


def test_settings_before_all_pieces_lose_nothing_and_without_any_are_refused(world: World) -> None:
    assert assert_refused(finish(world), 409, "UPLOAD_NOT_FINISHED")["offset"] == 0
    assert_refused(finish(world, file=("a", DATA)), 400, "MALFORMED_MULTIPART")
    assert_refused(finish(world, "../x"), 400, "INVALID_DIGEST")
    put(world, 0, 700)
    refused = finish(world, settings=("config.yml", b"method: neus"))
    assert assert_refused(refused, 409, "UPLOAD_NOT_FINISHED")["offset"] == offset(world) == 700


def test_all_pieces_that_wait_are_finished_without_a_body(world: World) -> None:
    put(world, 0, 2000, **WAIT)
    assert offset(world, **WAIT) == 2000
    assert ask(world).status_code == 201


def test_pieces_can_be_dropped(world: World) -> None:
    put(world, 0, 700)
    assert world.client.delete(f"/fields/{NAME}").status_code == 204
    assert world.blobs.blobs == {}
    assert_refused(world.client.delete(f"/fields/{NAME}"), 404, "FIELD_NOT_FOUND")


def test_pieces_count_towards_the_quota(worlds: Worlds) -> None:
    world = worlds(quota_stored_bytes=2500)
    put(world, 0, 1500)
    other = field_bytes("other", 1200)
    assert_refused(contract.put(world.client, other), 403, "QUOTA_STORED")
    assert put(world, 1500, 2000).status_code == 201
    assert_refused(put(world, 0, 600, other), 403, "QUOTA_STORED")


def test_each_caller_has_pieces_of_its_own(worlds: Worlds) -> None:
    world = worlds(api_tokens=TOKENS)
    assert put(world, 0, 700, **ALICE).status_code == 202
    assert offset(world, **BOB) == 0
    assert put(world, 0, 2000, **BOB).status_code == 201
    assert offset(world, **ALICE) == 700


def test_an_upload_has_so_many_pieces_at_most(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_service.fields.piecewise.MOST_PIECES", 3)
    for first in range(3):
        assert put(world, first * 600, first * 600 + 600).status_code == 202
    assert_refused(put(world, 1800, 2000), 409, "TOO_MANY_PIECES")


def test_the_oldest_uploads_give_way_and_those_that_do_not_go_on_expire(worlds: Worlds) -> None:
    world = worlds(keep_pieces_bytes=2000)
    put(world, 0, 700)
    world.blobs.age()
    second, third = field_bytes("second", 2000), field_bytes("third", 2000)
    put(world, 0, 1000, second)
    assert offset(world) == 700
    put(world, 0, 1000, third)
    assert [offset(world, data) for data in (DATA, second, third)] == [0, 1000, 1000]
    pieces, now = Pieces(world.blobs, world.settings), world.records.now()
    assert pieces.expire(now) == 0
    assert pieces.expire(now + world.settings.keep_pieces_s + 60) == 2
    assert world.blobs.blobs == {}


class Writers:
    """What the store is asked to write, the journal aside; and how many such writers are open at once."""

    def __init__(self, world: World, monkeypatch: pytest.MonkeyPatch) -> None:
        self.bytes = self.most_open = 0
        inner, lock, opened = world.blobs.writer, Lock(), set[int]()

        @contextmanager
        def writer() -> Iterator[LocalBlobWriter]:
            with inner() as made:
                write = made.write

                def counted(data: bytes) -> int:
                    if len(data) >= 1000:
                        with lock:
                            self.bytes += len(data)
                            opened.add(id(made))
                            self.most_open = max(self.most_open, len(opened))
                    return write(data)

                made.write = counted  # type: ignore[method-assign]
                yield made
                with lock:
                    opened.discard(id(made))

        monkeypatch.setattr(world.blobs, "writer", writer)


def test_to_finish_what_has_not_arrived_writes_nothing(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    for first, end in ((0, 0), (0, 700), (700, 1999)):
        if end:
            put(world, first, end)
        with monkeypatch.context() as patch:
            writers = Writers(world, patch)
            for _ in range(3):
                assert assert_refused(finish(world), 409, "UPLOAD_NOT_FINISHED")["offset"] == end
            assert writers.bytes == 0


def test_wrong_bytes_are_put_together_once(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    put(world, 0, 700, **WAIT)
    assert put(world, 700, 2000, sent=DATA[:1300], **WAIT).status_code == 202
    writers = Writers(world, monkeypatch)
    assert_refused(finish(world), 400, "DIGEST_MISMATCH")
    assert world.blobs.blobs == {}
    for _ in range(3):
        assert_refused(finish(world), 409, "UPLOAD_NOT_FINISHED")
    assert writers.bytes == 2000


def test_requests_to_finish_at_once_make_one_copy(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    put(world, 0, 2000, **WAIT)
    writers = Writers(world, monkeypatch)
    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(lambda _: finish(world), range(8)))
    assert sorted(answer.status_code for answer in answers) == [200] * 7 + [201]
    assert (writers.bytes, list(world.blobs.blobs)) == (2000, [ORIGINAL])


def test_uploads_of_a_caller_are_put_together_one_after_the_other(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [field_bytes(f"file {number}", 2000) for number in range(6)]
    for data in files:
        put(world, 0, 2000, data, **WAIT)
    writers = Writers(world, monkeypatch)
    with ThreadPoolExecutor(6) as threads:
        answers = list(threads.map(lambda data: finish(world, sha256(data)), files))
    assert [answer.status_code for answer in answers] == [201] * 6
    assert writers.most_open == 1


def test_what_the_field_has_no_room_for_is_not_put_together(worlds: Worlds, monkeypatch: pytest.MonkeyPatch) -> None:
    world = worlds(max_imports_per_caller=1, quota_stored_bytes=4000)
    put(world, 0, 2000, **WAIT)
    other = field_bytes("other", 900)
    assert contract.put(world.client, other).status_code == 201
    writers = Writers(world, monkeypatch)
    assert_refused(finish(world), 429, "QUOTA_ACTIVE_JOBS")
    assert writers.bytes == 0
    assert world.client.delete(f"/fields/{sha256(other)}").status_code == 204
    assert finish(world).status_code == 201, "the field takes the place of its pieces in the quota"


def test_pieces_that_are_deleted_while_they_are_put_together(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    put(world, 0, 2000, **WAIT)

    def gone(*_: object) -> Iterator[bytes]:
        raise FileNotFoundError
        yield b""

    monkeypatch.setattr(Pieces, "blocks", gone)
    assert_refused(finish(world), 409, "UPLOAD_NOT_FINISHED")
