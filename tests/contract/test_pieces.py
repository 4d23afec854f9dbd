"""Uploads in pieces: what has arrived whole stays, and the upload goes on behind it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

import httpx
import pytest
from redis import Redis

from regnf_core.importing.containers.sniff import HEAD_BYTES
from regnf_state.blobs.local import LocalBlobWriter
from regnf_state.pieces import MOST_PIECES, Pieces
from tests.contract.bad_input import announced
from tests.contract.world import ALICE, BOB, TOKENS, World, assert_refused, field_bytes, make_world, sha256

DATA = field_bytes("in pieces", 2000)
NAME = sha256(DATA)


def put(
    world: World, first: int, end: int, data: bytes = DATA, headers: Mapping[str, str] | None = None
) -> httpx.Response:
    """Send bytes ``first`` to ``end`` - 1 of a file."""
    span = {"Content-Range": f"bytes {first}-{end - 1}/{len(data)}"}
    return world.client.put(f"/fields/{sha256(data)}", content=data[first:end], headers={**span, **(headers or {})})


def ask(world: World, data: bytes = DATA, headers: Mapping[str, str] | None = None) -> httpx.Response:
    """How much of a file has arrived."""
    span = {"Content-Range": f"bytes */{len(data)}"}
    return world.client.put(f"/fields/{sha256(data)}", content=b"", headers={**span, **(headers or {})})


def test_pieces_make_the_field_that_the_whole_would_have_made(world: World) -> None:
    first = put(world, 0, 700)
    assert (first.status_code, first.headers["upload-offset"]) == (202, "700")
    assert first.json() == {"sha256": NAME, "offset": 700, "bytes": 2000}
    assert world.client.get(f"/fields/{NAME}").status_code == 404
    assert put(world, 700, 1500).json()["offset"] == 1500
    last = put(world, 1500, 2000)
    assert (last.status_code, last.json()["state"], last.json()["bytes"]) == (201, "validating", 2000)
    assert world.blobs.blobs == {f"fields/{NAME}/original": DATA}
    assert world.queue.imports == [(NAME, 1)]


def test_what_has_arrived_is_told(world: World) -> None:
    assert ask(world).json()["offset"] == 0
    put(world, 0, 700)
    assert (ask(world).status_code, ask(world).json()["offset"]) == (202, 700)


def test_a_piece_elsewhere_is_refused_with_where_it_stopped(world: World) -> None:
    put(world, 0, 700)
    for first in (0, 600, 701):
        answer = put(world, first, 1000)
        assert assert_refused(answer, 409, "UPLOAD_NOT_FINISHED")["offset"] == 700
        assert answer.headers["upload-offset"] == "700"
    assert ask(world).json()["offset"] == 700


def test_a_piece_that_breaks_off_is_not_kept(world: World) -> None:
    put(world, 0, 700)
    headers = {"Content-Range": "bytes 700-1999/2000"}
    answer = world.client.put(f"/fields/{NAME}", content=DATA[700:1500], headers=headers)
    assert_refused(answer, 400, "UPLOAD_INCOMPLETE")
    assert ask(world).json()["offset"] == 700


def test_the_last_piece_again_is_the_field(world: World) -> None:
    put(world, 0, 700)
    assert put(world, 700, 2000).status_code == 201
    assert put(world, 700, 2000).status_code == 200
    assert ask(world).json()["sha256"] == NAME
    assert list(world.blobs.blobs) == [f"fields/{NAME}/original"]


def test_bytes_that_are_not_the_announced_ones_are_not_kept(world: World) -> None:
    put(world, 0, 700)
    headers = {"Content-Range": "bytes 700-1999/2000"}
    answer = world.client.put(f"/fields/{NAME}", content=DATA[:1300], headers=headers)
    assert_refused(answer, 400, "DIGEST_MISMATCH")
    assert world.blobs.blobs == {}
    assert ask(world).json()["offset"] == 0


def test_the_digest_of_a_piece_is_compared(world: World) -> None:
    wrong = {"Content-Digest": announced(DATA)}
    assert_refused(put(world, 0, 700, headers=wrong), 400, "DIGEST_MISMATCH")
    assert put(world, 0, 700, headers={"Content-Digest": announced(DATA[:700])}).status_code == 202


def test_a_file_that_is_no_field_is_refused_with_its_first_piece(tmp_path: Path, any_redis: Redis) -> None:
    world = make_world(tmp_path, any_redis, max_upload_bytes=4 * HEAD_BYTES)
    picture = b"\x89PNG\r\n\x1a\n" + b"\0" * 2 * HEAD_BYTES
    assert_refused(put(world, 0, HEAD_BYTES, picture), 415, "FIELD_NOT_RECOGNIZED")
    assert world.blobs.blobs == {}


@pytest.mark.parametrize(
    ("header", "status", "reason"),
    [
        ("bytes 0-9", 400, "INVALID_HEADER"),
        ("bytes 9-0/2000", 400, "INVALID_HEADER"),
        ("bytes 0-2000/2000", 400, "INVALID_HEADER"),
        ("items 0-9/2000", 400, "INVALID_HEADER"),
        ("bytes 0-9/*", 400, "INVALID_HEADER"),
        ("bytes 0-9/9999999999999999", 400, "INVALID_HEADER"),
        ("bytes 0-9/5000", 413, "UPLOAD_TOO_LARGE"),
        ("bytes */0", 400, "UPLOAD_INCOMPLETE"),
        ("bytes 0-9/2000", 400, "INVALID_HEADER"),
        ("bytes */2000", 400, "INVALID_HEADER"),
    ],
)
def test_a_wrong_range_is_refused(world: World, header: str, status: int, reason: str) -> None:
    answer = world.client.put(f"/fields/{NAME}", content=DATA[:700], headers={"Content-Range": header})
    assert_refused(answer, status, reason)
    assert world.blobs.blobs == {}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_settings_go_with_pieces(world: World, encoding: str) -> None:
    wait = {"Upload-Complete": "?0"}
    put(world, 0, 700, headers=wait)
    assert put(world, 700, 2000, headers=wait).json()["offset"] == 2000
    files: dict[str, Any] = {
        "upload": (None, f"{NAME}\r\n".encode(encoding)),
        "description": (None, json.dumps({"label": "room"}).encode(encoding), "application/json"),
        "settings": ("config.yml", b"method: neus"),
    }
    answer = world.client.post("/fields", files=files)
    assert answer.status_code == 201, answer.text
    assert (answer.json()["label"], answer.json()["settings"]["name"]) == ("room", "config.yml")
    assert world.blobs.blobs[f"fields/{NAME}/original"] == DATA
    assert not [key for key in world.blobs.blobs if key.startswith("uploads/")]


def test_settings_before_all_pieces_lose_nothing(world: World) -> None:
    put(world, 0, 700)
    files: dict[str, Any] = {"upload": (None, NAME), "settings": ("config.yml", b"method: neus")}
    assert assert_refused(world.client.post("/fields", files=files), 409, "UPLOAD_NOT_FINISHED")["offset"] == 700
    assert ask(world).json()["offset"] == 700


def test_settings_without_pieces_are_refused(world: World) -> None:
    files: dict[str, Any] = {"upload": (None, NAME)}
    assert assert_refused(world.client.post("/fields", files=files), 409, "UPLOAD_NOT_FINISHED")["offset"] == 0
    both: dict[str, Any] = {"upload": (None, NAME), "file": ("a", DATA)}
    assert_refused(world.client.post("/fields", files=both), 400, "MALFORMED_MULTIPART")
    assert_refused(world.client.post("/fields", files={"upload": (None, "../x")}), 400, "INVALID_DIGEST")


def test_all_pieces_that_wait_are_finished_without_a_body(world: World) -> None:
    put(world, 0, 2000, headers={"Upload-Complete": "?0"})
    assert ask(world, headers={"Upload-Complete": "?0"}).json()["offset"] == 2000
    assert ask(world).status_code == 201


def test_pieces_can_be_dropped(world: World) -> None:
    put(world, 0, 700)
    assert world.client.delete(f"/fields/{NAME}").status_code == 204
    assert world.blobs.blobs == {}
    assert_refused(world.client.delete(f"/fields/{NAME}"), 404, "FIELD_NOT_FOUND")


def test_pieces_count_towards_the_quota(worlds: Callable[..., World]) -> None:
    world = worlds(quota_stored_bytes=2500)
    put(world, 0, 1500)
    other = field_bytes("other", 1200)
    assert_refused(world.client.put(f"/fields/{sha256(other)}", content=other), 403, "QUOTA_STORED")
    assert put(world, 1500, 2000).status_code == 201
    assert_refused(put(world, 0, 600, other), 403, "QUOTA_STORED")


def test_each_caller_has_pieces_of_its_own(worlds: Callable[..., World]) -> None:
    world = worlds(api_tokens=TOKENS)
    assert put(world, 0, 700, headers=ALICE).status_code == 202
    assert ask(world, headers=BOB).json()["offset"] == 0
    assert put(world, 0, 2000, headers=BOB).status_code == 201
    assert ask(world, headers=ALICE).json()["offset"] == 700


def test_an_upload_has_so_many_pieces_at_most(world: World) -> None:
    for offset in range(MOST_PIECES):
        world.blobs.put(f"uploads/anonymous/{NAME}/{offset:015d}-2000", b"x")
    assert_refused(put(world, MOST_PIECES, 2000), 409, "TOO_MANY_PIECES")


def test_the_oldest_uploads_give_way(worlds: Callable[..., World]) -> None:
    world = worlds(keep_pieces_bytes=2000)
    put(world, 0, 700)
    world.blobs.age()
    second, third = field_bytes("second", 2000), field_bytes("third", 2000)
    put(world, 0, 1000, second)
    assert ask(world).json()["offset"] == 700
    put(world, 0, 1000, third)
    assert [ask(world, data).json()["offset"] for data in (DATA, second, third)] == [0, 1000, 1000]


def test_uploads_that_do_not_go_on_expire(world: World, any_redis: Redis) -> None:
    put(world, 0, 700)
    pieces = Pieces(world.blobs, world.settings)
    now = world.records.now()
    assert pieces.expire(now) == 0
    assert pieces.expire(now + world.settings.keep_pieces_s + 60) == 1
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


def finish(world: World, name: str = NAME) -> httpx.Response:
    """Ask for the field of the pieces that have come, in a request of 200 bytes."""
    return world.client.post("/fields", files={"upload": (None, name)})


@pytest.mark.parametrize("arrived", [0, 700, 1999])
def test_to_finish_what_has_not_arrived_writes_nothing(
    world: World, monkeypatch: pytest.MonkeyPatch, arrived: int
) -> None:
    if arrived:
        put(world, 0, arrived)
    writers = Writers(world, monkeypatch)
    for _ in range(5):
        assert assert_refused(finish(world), 409, "UPLOAD_NOT_FINISHED")["offset"] == arrived
    assert writers.bytes == 0


def test_wrong_bytes_are_put_together_once(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    wait = {"Upload-Complete": "?0"}
    put(world, 0, 700, headers=wait)
    headers = {"Content-Range": "bytes 700-1999/2000", **wait}
    assert world.client.put(f"/fields/{NAME}", content=DATA[:1300], headers=headers).status_code == 202
    writers = Writers(world, monkeypatch)
    assert_refused(finish(world), 400, "DIGEST_MISMATCH")
    assert world.blobs.blobs == {}
    for _ in range(3):
        assert_refused(finish(world), 409, "UPLOAD_NOT_FINISHED")
    assert writers.bytes == 2000


def test_requests_to_finish_at_once_make_one_copy(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    put(world, 0, 2000, headers={"Upload-Complete": "?0"})
    writers = Writers(world, monkeypatch)
    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(lambda _: finish(world), range(8)))
    assert sorted(answer.status_code for answer in answers) == [200] * 7 + [201]
    assert writers.bytes == 2000
    assert list(world.blobs.blobs) == [f"fields/{NAME}/original"]


def test_uploads_of_a_caller_are_put_together_one_after_the_other(
    worlds: Callable[..., World], monkeypatch: pytest.MonkeyPatch
) -> None:
    world = worlds()
    files = [field_bytes(f"file {number}", 2000) for number in range(6)]
    for data in files:
        put(world, 0, 2000, data, {"Upload-Complete": "?0"})
    writers = Writers(world, monkeypatch)
    with ThreadPoolExecutor(6) as threads:
        answers = list(threads.map(lambda data: finish(world, sha256(data)), files))
    assert [answer.status_code for answer in answers] == [201] * 6
    assert writers.most_open == 1


def test_what_the_field_has_no_room_for_is_not_put_together(
    worlds: Callable[..., World], monkeypatch: pytest.MonkeyPatch
) -> None:
    world = worlds(max_imports_per_caller=1, quota_stored_bytes=4000)
    put(world, 0, 2000, headers={"Upload-Complete": "?0"})
    other = field_bytes("other", 900)
    assert world.client.put(f"/fields/{sha256(other)}", content=other).status_code == 201
    writers = Writers(world, monkeypatch)
    assert_refused(finish(world), 429, "QUOTA_ACTIVE_JOBS")
    assert writers.bytes == 0
    assert world.client.delete(f"/fields/{sha256(other)}").status_code == 204
    assert finish(world).status_code == 201, "the field takes the place of its pieces in the quota"


def test_pieces_are_of_one_file(world: World) -> None:
    put(world, 0, 700)
    headers = {"Content-Range": "bytes 700-1999/2400"}
    assert_refused(world.client.put(f"/fields/{NAME}", content=DATA[700:2000], headers=headers), 400, "INVALID_HEADER")
    assert put(world, 700, 2000).status_code == 201


def test_pieces_that_are_deleted_while_they_are_put_together(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    put(world, 0, 2000, headers={"Upload-Complete": "?0"})

    def gone(*_: object) -> Iterator[bytes]:
        raise FileNotFoundError
        yield b""

    monkeypatch.setattr(Pieces, "blocks", gone)
    assert_refused(finish(world), 409, "UPLOAD_NOT_FINISHED")
