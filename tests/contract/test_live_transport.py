"""The application under a real server: clients that misbehave, large uploads, streams, and the end of it all."""

from __future__ import annotations

import hashlib
import json
import socket
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.contract.live import MAX_UPLOAD, Live, eventually, live_service
from tests.contract.world import assert_refused, field_bytes, sha256

MIB = 1 << 20
pytestmark = [pytest.mark.usefixtures("nothing_stays_live"), pytest.mark.xdist_group("live api")]


def head_of(method: str, path: str, **headers: object) -> bytes:
    lines = [f"{method} {path} HTTP/1.1", "Host: localhost"]
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


def answer_of(connection: socket.socket) -> tuple[int, bytes]:
    """Status and everything else that comes until the server closes or has sent a whole problem."""
    text = b""
    while b"request_id" not in text or not text.rstrip().endswith(b"}"):
        data = connection.recv(65536)
        if not data:
            break
        text += data
    return int(text.split(b" ", 2)[1]), text


def test_a_large_upload_arrives_whole_and_in_little_memory(live: Live) -> None:
    block = bytes(range(256)) * 4096
    start = field_bytes("large", MIB)
    digest = hashlib.sha256(start + block * 99).hexdigest()

    def pieces() -> Iterator[bytes]:
        yield start
        for _ in range(99):
            yield block

    with live.client() as client:
        answer = client.put(f"/fields/{digest}", content=pieces())
        assert (answer.status_code, answer.json()["bytes"]) == (201, 100 * MIB)
    stored = live.folder / "blobs" / "fields" / digest / "original"
    with stored.open("rb") as file:
        assert hashlib.file_digest(file, "sha256").hexdigest() == digest
    assert live.peak_memory() < 200e6


def test_polls_are_answered_during_an_upload(live: Live) -> None:
    data = field_bytes("slow", 2 * MIB)
    half_sent, may_end = threading.Event(), threading.Event()

    def pieces() -> Iterator[bytes]:
        yield data[:MIB]
        half_sent.set()
        may_end.wait(0.8)
        yield data[MIB:]

    def upload() -> None:
        with live.client() as client:
            answers.append(client.put(f"/fields/{sha256(data)}", content=pieces()))

    answers: list[httpx.Response] = []
    thread = threading.Thread(target=upload)
    thread.start()
    assert half_sent.wait(20)
    with live.client() as client:
        assert [client.get("/jobs").status_code for _ in range(5)] == [200] * 5
    may_end.set()
    thread.join()
    assert answers[0].status_code == 201


def test_a_body_longer_than_declared_is_cut_where_it_was_declared_to_end(live: Live) -> None:
    data = field_bytes("long")
    with live.connect() as connection:
        connection.sendall(
            head_of("PUT", f"/fields/{sha256(data)}", Content_Length=len(data)) + data + b"\0more\r\n\r\n"
        )
        connection.settimeout(20)
        text = b""
        while b"validating" not in text:
            text += connection.recv(65536)
    assert text.startswith(b"HTTP/1.1 201")


def test_a_client_that_asks_first_is_spared_the_upload(live: Live) -> None:
    path = f"/fields/{'0' * 64}"
    with live.connect() as connection:
        connection.sendall(head_of("PUT", path, Content_Length=MAX_UPLOAD + 1, Expect="100-continue"))
        status, text = answer_of(connection)
    assert (status, b"UPLOAD_TOO_LARGE" in text, b"100 Continue" in text) == (413, True, False)


def test_a_refusal_reaches_a_client_that_goes_on_sending(live: Live) -> None:
    """The server stops reading; the client must still find the answer, not only a broken connection."""
    data = b"\x89PNG" + bytes(8 * MIB)
    with live.client() as client:
        answer = client.put(f"/fields/{sha256(data)}", content=data)
    assert_refused(answer, 415, "FIELD_NOT_RECOGNIZED")


@pytest.mark.parametrize("line", [b"GET", b"\x00\x01\x02", b"GET /" + b"a" * 200_000 + b" HTTP/1.1"])
def test_what_is_no_http_is_refused_by_the_server(live: Live, line: bytes) -> None:
    with live.connect() as connection:
        connection.sendall(line + b"\r\nHost: x\r\n\r\n")
        assert connection.recv(1024).startswith(b"HTTP/1.1 4")
    with live.client() as client:
        assert client.get("/healthz").status_code == 200


def submit(client: httpx.Client, seed: int = 0) -> str:
    shas = []
    for name in ("scene", "object"):
        data = field_bytes(name)
        client.put(f"/fields/{sha256(data)}", content=data)
        shas.append(sha256(data))
    body = {"scene": shas[0], "object": shas[1], "detection": {"min": [0, 0, 0], "max": [1, 1, 1]}, "seed": seed}
    answer = client.post("/register", json=body)
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


def test_a_stream_that_is_never_read_keeps_nobody_waiting(live: Live) -> None:
    with live.client() as client:
        job_id = submit(client)
        with live.connect() as first, live.connect() as second:
            for connection in (first, second):
                connection.sendall(head_of("GET", f"/jobs/{job_id}/events"))
            assert client.get(f"/jobs/{job_id}").json()["status"] == "accepted"
            client.post(f"/jobs/{job_id}/cancel")
        assert client.delete(f"/jobs/{job_id}").status_code == 204


def test_events_arrive_as_they_happen(live: Live) -> None:
    with live.client() as client, live.client() as other:
        job_id = submit(client, seed=1)
        with client.stream("GET", f"/jobs/{job_id}/events") as stream:
            states = []
            for line in stream.iter_lines():
                if line.startswith("data: "):
                    states.append(json.loads(line.removeprefix("data: "))["status"])
                    if states == ["accepted"]:
                        other.post(f"/jobs/{job_id}/cancel")
        assert states == ["accepted", "dismissed"]
        client.delete(f"/jobs/{job_id}")


def test_told_to_stop_it_ends_open_streams_and_waits_and_leaves(tmp_path: Path) -> None:
    with live_service(tmp_path, with_worker=False) as ending, ending.client() as client, ending.connect() as waiter:
        job_id = submit(client)
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
        assert "Traceback" not in ending.log()


def test_told_to_stop_during_an_upload_it_leaves_nothing_of_it(tmp_path: Path) -> None:
    data = field_bytes("stopped", 4 * MIB)
    with live_service(tmp_path, with_worker=False) as ending, ending.connect() as upload:
        before = ending.files()
        upload.sendall(head_of("PUT", f"/fields/{sha256(data)}", Content_Length=len(data)) + data[: 2 * MIB])
        eventually(lambda: ending.files() - before, "the first bytes in the store")
        ending.api.terminate()
        try:
            ending.api.wait(20)
        except subprocess.TimeoutExpired:
            pytest.fail("the API did not end")
        assert ending.files() - before == set()
