"""Uploads over a real server that go wrong on the way. Each test ends with the store as empty as it began."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from tests.contract.live import MAX_UPLOAD, Live, eventually
from tests.contract.test_live_transport import answer_of, head_of
from tests.contract.world import assert_refused, field_bytes, sha256

pytestmark = [pytest.mark.usefixtures("nothing_stays_live"), pytest.mark.xdist_group("live api")]


@pytest.fixture
def client(live: Live) -> Iterator[httpx.Client]:
    with live.client() as made:
        yield made


@pytest.mark.parametrize("length", [MAX_UPLOAD + 1, 10**12, 10**18])
def test_too_large_by_its_header(live: Live, length: int) -> None:
    with live.connect() as connection:
        connection.sendall(head_of("POST", "/fields", Content_Length=length))
        status, text = answer_of(connection)
    assert (status, b"UPLOAD_TOO_LARGE" in text) == (413, True)


def test_a_chunk_whose_length_is_no_number(live: Live) -> None:
    with live.connect() as connection:
        connection.sendall(head_of("POST", "/fields", Transfer_Encoding="chunked") + b"zz\r\n" + b"x" * 600)
        assert connection.recv(65536).split(b" ")[1] == b"400"


def test_a_thousand_aborted_uploads_leave_nothing(live: Live, client: httpx.Client) -> None:
    """Broken off in the header, at the first byte, in the middle, and just before the end."""
    data = field_bytes("aborted", 100_000)
    head = head_of("PUT", f"/fields/{sha256(data)}", Content_Length=len(data))
    ends = (len(head) - 4, len(head) + 1, len(head) + 50_000, len(head) + len(data) - 1)
    for index in range(1000):
        with live.connect() as connection:
            connection.sendall((head + data)[: ends[index % len(ends)]])
    eventually(lambda: live.files() == set(), "an empty store")
    # until the broken-off requests are cleared away they count as requests in progress
    eventually(lambda: client.get("/fields").status_code == 200, "an answer")
    assert client.get("/fields").json()["fields"] == []


def test_a_trickle_keeps_nobody_else_waiting(live: Live, client: httpx.Client) -> None:
    """A byte at a time is never a stall, and costs a connection, nothing more."""
    data = field_bytes("trickle")
    stop = threading.Event()

    def trickle() -> None:
        with live.connect() as connection:
            connection.sendall(head_of("POST", "/fields", Content_Length=len(data)))
            for at in range(len(data)):
                connection.sendall(data[at : at + 1])
                if stop.wait(0.1):
                    return

    with ThreadPoolExecutor(20) as pool:
        slow = [pool.submit(trickle) for _ in range(20)]
        try:
            good = field_bytes("meanwhile")
            assert client.put(f"/fields/{sha256(good)}", content=good).status_code == 201
            assert client.delete(f"/fields/{sha256(good)}").status_code == 204
        finally:
            stop.set()
        for ended in slow:
            ended.result()


def test_eight_uploads_of_one_file_at_once_are_one_field(live: Live, client: httpx.Client) -> None:
    data = field_bytes("twins", 500_000)

    def upload(_: int) -> int:
        with live.client() as own:
            return own.put(f"/fields/{sha256(data)}", content=data).status_code

    with ThreadPoolExecutor(8) as pool:
        answers = sorted(pool.map(upload, range(8)))
    assert answers == [200] * 7 + [201]
    assert live.files() == {f"fields/{sha256(data)}/original"}
    assert client.delete(f"/fields/{sha256(data)}").status_code == 204


def test_a_file_under_anothers_name_takes_nobodys_place(live: Live, client: httpx.Client) -> None:
    mine, other = field_bytes("mine"), field_bytes("other")
    assert client.put(f"/fields/{sha256(mine)}", content=mine).status_code == 201
    assert_refused(client.put(f"/fields/{sha256(mine)}", content=other), 400, "DIGEST_MISMATCH")
    assert live.files() == {f"fields/{sha256(mine)}/original"}
    assert (live.folder / "blobs" / "fields" / sha256(mine) / "original").read_bytes() == mine
    assert client.delete(f"/fields/{sha256(mine)}").status_code == 204
