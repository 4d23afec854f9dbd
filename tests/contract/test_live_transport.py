"""The application under a real server: uploads that go wrong on the way, streams, and the end of it all.

Each test ends with the store as empty as it began.
"""

from __future__ import annotations

import hashlib
import json
import socket
import subprocess
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.contract.live import MAX_UPLOAD, Live, eventually, live_service
from tests.contract.world import assert_refused, field_bytes, put, sha256

MIB = 1 << 20
NOBODYS = f"/fields/{'0' * 64}"
pytestmark = [pytest.mark.usefixtures("nothing_stays_live"), pytest.mark.xdist_group("live api")]


@pytest.fixture
def client(live: Live) -> Iterator[httpx.Client]:
    with live.client() as made:
        yield made


def head_of(method: str, path: str, **headers: object) -> bytes:
    lines = [f"{method} {path} HTTP/1.1", "Host: localhost"]
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


def upload_of(data: bytes) -> bytes:
    return head_of("PUT", f"/fields/{sha256(data)}", Content_Length=len(data)) + data


def answer_of(connection: socket.socket) -> tuple[int, bytes]:
    """Status and everything else that comes until the server closes or has sent a whole problem."""
    text = b""
    while b"request_id" not in text or not text.rstrip().endswith(b"}"):
        data = connection.recv(65536)
        if not data:
            break
        text += data
    return int(text.split(b" ", 2)[1]), text


def test_a_large_upload_arrives_whole_and_in_little_memory(live: Live, client: httpx.Client) -> None:
    block = bytes(range(256)) * 4096
    start = field_bytes("large", MIB)
    digest = hashlib.sha256(start + block * 99).hexdigest()

    def pieces() -> Iterator[bytes]:
        yield start
        for _ in range(99):
            yield block

    answer = client.put(f"/fields/{digest}", content=pieces())
    assert (answer.status_code, answer.json()["bytes"]) == (201, 100 * MIB)
    with (live.folder / "blobs" / "fields" / digest / "original").open("rb") as file:
        assert hashlib.file_digest(file, "sha256").hexdigest() == digest
    assert live.peak_memory() < 200e6


def test_others_are_answered_during_uploads_however_slow(live: Live, client: httpx.Client) -> None:
    """A byte at a time is never a stall, and costs a connection, nothing more."""
    data, trickled = field_bytes("slow", 2 * MIB), field_bytes("trickle")
    half_sent, may_end = threading.Event(), threading.Event()

    def pieces() -> Iterator[bytes]:
        yield data[:MIB]
        half_sent.set()
        may_end.wait(20)
        yield data[MIB:]

    def upload() -> int:
        with live.client() as own:
            return own.put(f"/fields/{sha256(data)}", content=pieces()).status_code

    def trickle() -> None:
        with live.connect() as connection:
            connection.sendall(head_of("POST", "/fields", Content_Length=len(trickled)))
            for at in range(len(trickled)):
                connection.sendall(trickled[at : at + 1])
                if may_end.wait(0.1):
                    return

    with ThreadPoolExecutor(21) as pool:
        slow = [pool.submit(trickle) for _ in range(20)]
        uploading = pool.submit(upload)
        try:
            assert half_sent.wait(20)
            good = field_bytes("meanwhile")
            assert put(client, good).status_code == 201
            assert client.delete(f"/fields/{sha256(good)}").status_code == 204
        finally:
            may_end.set()
        assert uploading.result() == 201
        for ended in slow:
            ended.result()


def test_uploads_that_are_too_large(live: Live) -> None:
    heads = [head_of("PUT", NOBODYS, Content_Length=MAX_UPLOAD + 1, Expect="100-continue")]
    heads += [head_of("POST", "/fields", Content_Length=length) for length in (MAX_UPLOAD + 1, 10**12, 10**18)]
    for sent in heads:
        with live.connect() as connection:
            connection.sendall(sent)
            status, text = answer_of(connection)
        assert (status, b"UPLOAD_TOO_LARGE" in text, b"100 Continue" in text) == (413, True, False)


def test_a_body_longer_than_declared_is_cut_where_it_was_declared_to_end(live: Live) -> None:
    with live.connect() as connection:
        connection.sendall(upload_of(field_bytes("long")) + b"\0more\r\n\r\n")
        connection.settimeout(20)
        text = b""
        while b"validating" not in text:
            text += connection.recv(65536)
    assert text.startswith(b"HTTP/1.1 201")


def test_a_refusal_reaches_a_client_that_goes_on_sending(client: httpx.Client) -> None:
    """The server stops reading; the client must still find the answer, not only a broken connection."""
    assert_refused(put(client, b"\x89PNG" + bytes(8 * MIB)), 415, "FIELD_NOT_RECOGNIZED")


def test_what_is_no_http_is_refused_by_the_server(live: Live, client: httpx.Client) -> None:
    rest = b"\r\nHost: x\r\n\r\n"
    chunks = head_of("POST", "/fields", Transfer_Encoding="chunked") + b"zz\r\n" + b"x" * 600
    for sent in (b"GET" + rest, b"\x00\x01\x02" + rest, b"GET /" + b"a" * 200_000 + b" HTTP/1.1" + rest, chunks):
        with live.connect() as connection:
            connection.sendall(sent)
            assert connection.recv(1024).startswith(b"HTTP/1.1 4")
    assert client.get("/healthz").status_code == 200


def test_hundreds_of_aborted_uploads_leave_nothing(live: Live, client: httpx.Client) -> None:
    """Broken off in the header, at the first byte, in the middle, and just before the end."""
    data = field_bytes("aborted", 100_000)
    sent = upload_of(data)
    head = len(sent) - len(data)
    ends = (head - 4, head + 1, head + 50_000, len(sent) - 1)
    for index in range(300):
        with live.connect() as connection:
            connection.sendall(sent[: ends[index % len(ends)]])
    eventually(lambda: live.files() == set(), "an empty store")
    # until the broken-off requests are cleared away they count as requests in progress
    eventually(lambda: client.get("/fields").status_code == 200, "an answer")
    assert client.get("/fields").json()["fields"] == []


def test_eight_uploads_of_one_file_at_once_are_one_field(live: Live, client: httpx.Client) -> None:
    data = field_bytes("twins", 500_000)

    def upload(_: int) -> int:
        with live.client() as own:
            return put(own, data).status_code

    with ThreadPoolExecutor(8) as pool:
        assert sorted(pool.map(upload, range(8))) == [200] * 7 + [201]
    name = f"fields/{sha256(data)}"
    assert_refused(client.put(f"/{name}", content=field_bytes("other")), 400, "DIGEST_MISMATCH")
    assert live.files() == {f"{name}/original"}
    assert (live.folder / "blobs" / name / "original").read_bytes() == data


def submit(client: httpx.Client, **more: Any) -> str:
    data = {name: field_bytes(name) for name in ("scene", "object")}
    for one in data.values():
        put(client, one)
    body = (
        {name: sha256(one) for name, one in data.items()} | {"detection": {"min": [0, 0, 0], "max": [1, 1, 1]}} | more
    )
    answer = client.post("/register", json=body)
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


def test_events_arrive_as_they_happen_and_streams_that_nobody_reads_keep_nobody_waiting(
    live: Live, client: httpx.Client
) -> None:
    job_id = submit(client)
    with live.connect() as first, live.connect() as second, live.client() as reader:
        for connection in (first, second):
            connection.sendall(head_of("GET", f"/jobs/{job_id}/events"))
        states = []
        with reader.stream("GET", f"/jobs/{job_id}/events") as stream:
            for line in stream.iter_lines():
                if line.startswith("data: "):
                    states.append(json.loads(line.removeprefix("data: "))["status"])
                    if states == ["accepted"]:
                        client.post(f"/jobs/{job_id}/cancel")
    assert states == ["accepted", "dismissed"]
    assert client.delete(f"/jobs/{job_id}").status_code == 204


def test_told_to_stop_it_ends_streams_and_waits_leaves_nothing_of_an_upload_and_goes(tmp_path: Path) -> None:
    data = field_bytes("stopped", 4 * MIB)
    with live_service(tmp_path, with_worker=False) as ending, ending.client() as client:
        job_id = submit(client)
        before = ending.files()
        with ending.connect() as waiter, ending.connect() as upload:
            upload.sendall(upload_of(data)[: 2 * MIB])
            eventually(lambda: ending.files() - before, "the first bytes in the store")
            waiter.sendall(head_of("GET", f"/jobs/{job_id}?wait=30"))
            with client.stream("GET", f"/jobs/{job_id}/events") as stream:
                lines = stream.iter_lines()
                while not next(lines).startswith("data: "):
                    pass
                # the stream was asked for after the wait, so both are being served now
                ending.api.terminate()
                rest = list(lines)
            assert rest[-1:] in ([], [""])
            assert waiter.recv(1024).startswith(b"HTTP/1.1 200")
            try:
                ending.api.wait(20)
            except subprocess.TimeoutExpired:
                pytest.fail("the API did not end")
            assert ending.files() - before == set()
        before_the_upload_was_given_up = ending.log().partition("timeout graceful shutdown exceeded")[0]
        assert "Traceback" not in before_the_upload_was_given_up


# requests whose end two parties may see at different places: refused, so that no proxy in front can be misled


HIDDEN = b"GET /version HTTP/1.1\r\nHost: localhost\r\n\r\n"
BODY = b"0\r\n\r\n" + HIDDEN


@pytest.mark.parametrize(
    "head",
    [
        b"GET /healthz HTTP/1.1\r\nTransfer-Encoding: chunked\r\nContent-Length: %d\r\n" % len(BODY),
        b"GET /healthz HTTP/1.1\r\nContent-Length: %d\r\nTransfer-Encoding: Chunked\r\n" % len(BODY),
        b"POST /register HTTP/1.1\r\nContent-Length: 0\r\nTransfer-Encoding: chunked\r\n",
    ],
)
def test_a_body_with_two_lengths_is_refused_and_nothing_after_it_is_read(live: Live, head: bytes) -> None:
    with live.connect() as connection:
        connection.settimeout(20)
        connection.sendall(head + b"Host: localhost\r\n\r\n" + BODY)
        text = b""
        while data := connection.recv(65536):
            text += data
    assert text.startswith(b"HTTP/1.1 400 ")
    assert text.count(b"HTTP/1.1 ") == 1
    assert b"INVALID_HEADER" in text
