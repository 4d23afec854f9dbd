"""Clients that are slow on purpose, under the real server: each is cut off, and nobody else waits for them."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import httpx
import pytest

from tests.contract.live import Live, eventually, live_service
from tests.contract.world import field_bytes, sha256

LIMITS: dict[str, object] = {
    "header_timeout_s": 1.0, "upload_stall_s": 1.0, "min_bytes_per_s": 1e5, "max_connections": 60,
    "max_connections_per_address": 50, "max_upload_bytes": 8 << 20,
}  # fmt: skip
HEAD = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n"


@pytest.fixture(scope="module")
def hurried(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A real API with little patience and few connections."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    folder = tmp_path_factory.mktemp("hurried")
    with live_service(folder, with_worker=False, metrics_address=f"127.0.0.1:{port}", **LIMITS) as started:
        started.metrics_port = port  # type: ignore[attr-defined]
        yield started


def ended(connection: socket.socket) -> bytes:
    """What still comes until the server closes the connection; fails if it does not."""
    connection.settimeout(20)
    text = b""
    try:
        while data := connection.recv(65536):
            text += data
    except ConnectionResetError:
        pass
    return text


def ended_while_trickling(connection: socket.socket, drop: bytes) -> bytes:
    """The same while a byte is sent every now and then."""
    connection.settimeout(0.1)
    text = b""
    end = time.monotonic() + 20
    while time.monotonic() < end:
        try:
            connection.sendall(drop)
            data = connection.recv(65536)
        except TimeoutError:
            continue
        except OSError:
            return text
        if not data:
            return text
        text += data
    pytest.fail("the connection was not closed")


def test_an_unfinished_head_is_cut_off(hurried: Live) -> None:
    with hurried.connect() as silent, hurried.connect() as begun, hurried.connect() as trickling:
        begun.sendall(HEAD)
        trickling.sendall(HEAD)
        assert b"REQUEST_STALLED" in ended_while_trickling(trickling, b"x")
        assert ended(begun).startswith(b"HTTP/1.1 408 ")
        assert ended(silent) == b""


def test_a_second_head_has_no_more_time(hurried: Live) -> None:
    with hurried.connect() as connection:
        connection.sendall(HEAD + b"\r\n" + HEAD)
        text = ended_while_trickling(connection, b"x")
    assert text.startswith(b"HTTP/1.1 200 ")
    assert b"REQUEST_STALLED" in text


@pytest.mark.parametrize("head", [b"POST /fields HTTP/1.1\r\n", b"PUT /fields/%s HTTP/1.1\r\n" % (b"0" * 64)])
def test_a_trickled_upload_is_cut_off(hurried: Live, head: bytes) -> None:
    """Each byte comes well before the server would call it a stall."""
    with hurried.connect() as connection:
        connection.sendall(head + b"Host: localhost\r\nContent-Length: 4000000\r\n\r\n" + field_bytes("trickled"))
        assert b"REQUEST_STALLED" in ended_while_trickling(connection, b"\0")


def test_a_body_that_nobody_reads_is_cut_off(hurried: Live) -> None:
    head = b"POST /nowhere HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4000000\r\n\r\n"
    with hurried.connect() as connection:
        connection.sendall(head)
        assert ended_while_trickling(connection, b"\0").startswith(b"HTTP/1.1 404 ")


def test_answers_that_nobody_reads_are_cut_off(hurried: Live) -> None:
    """They fill the buffers of both sides, until the server has to wait."""
    with hurried.connect() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.settimeout(20)
        request = b"GET /openapi.yaml HTTP/1.1\r\nHost: localhost\r\n\r\n"
        with hurried.client() as other, pytest.raises(OSError, match=r"reset|[Bb]roken"):
            send_for_ever(connection, request, other)


def send_for_ever(connection: socket.socket, request: bytes, other: httpx.Client) -> None:
    """Each once the one before it should be answered."""
    while True:
        connection.sendall(request)
        other.get("/openapi.yaml")


def test_others_are_answered_whatever_holds_the_connections(hurried: Live) -> None:
    with ExitStack() as stack, hurried.client() as client:
        job_stream = stack.enter_context(hurried.connect())
        for _ in range(400):
            connection = stack.enter_context(hurried.connect())
            connection.sendall(HEAD)
        # while all of them come in at once, nobody is served better than they are
        assert eventually(lambda: client.get("/healthz").status_code == 200, "an answer")
        data = field_bytes("honest", 1 << 20)
        assert client.put(f"/fields/{sha256(data)}", content=data).status_code == 201
        assert client.delete(f"/fields/{sha256(data)}").status_code == 204
        assert job_stream.fileno() > 0
        metrics = httpx.get(f"http://127.0.0.1:{hurried.metrics_port}/metrics").text  # type: ignore[attr-defined]
    held = re.search(r"^regnf_connections (\d+)", metrics, re.MULTILINE)
    refused = re.search(r'^regnf_connections_refused_total{cause="address"} (\d+)', metrics, re.MULTILINE)
    assert held is not None
    assert int(held[1]) <= 50
    assert refused is not None
    assert int(refused[1]) >= 300
    assert re.search(r"^regnf_open_file_descriptors \d", metrics, re.MULTILINE)


def test_those_who_are_served_are_never_cut_off(hurried: Live) -> None:
    """A long poll and an event stream outlast all limits, while others fill the connections."""
    with hurried.client() as client, ExitStack() as stack:
        job = submit(client)
        stream = stack.enter_context(client.stream("GET", f"/jobs/{job}/events"))
        poll = stack.enter_context(hurried.connect())
        poll.sendall(f"GET /jobs/{job}?wait=4 HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
        for _ in range(200):
            stack.enter_context(hurried.connect())
        assert ended(poll).startswith(b"HTTP/1.1 200 ")
        with hurried.client() as other:
            other.post(f"/jobs/{job}/cancel")
            assert "dismissed" in "".join(stream.iter_lines())
            other.delete(f"/jobs/{job}")
    with hurried.client() as client:
        for field in client.get("/fields").json()["fields"]:
            client.delete(f"/fields/{field['sha256']}")


def submit(client: httpx.Client) -> str:
    for name in ("scene", "object"):
        client.put(f"/fields/{sha256(field_bytes(name))}", content=field_bytes(name))
    names = {name: sha256(field_bytes(name)) for name in ("scene", "object")}
    answer = client.post("/register", json=names | {"detection": {"min": [0, 0, 0], "max": [1, 1, 1]}})
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (HEAD + b"a: b\r\n" * 2000 + b"\r\n", 431),
        (HEAD + b"x: " + b"a" * 100_000 + b"\r\n\r\n", 431),
        (
            b"POST /fields HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n" + b"1\r\n\0\r\n" * 4000,
            400,
        ),
        (b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n", 400),
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n", 400),
    ],
    ids=["many lines", "long line", "tiny chunks", "two hosts", "not HTTP"],
)
def test_what_costs_more_than_it_is_worth_is_refused(hurried: Live, request_: bytes, status: int) -> None:
    with hurried.connect() as connection:
        with suppress(OSError):
            connection.sendall(request_)
        text = ended(connection)
    assert text == b"" or int(text.split()[1]) == status
    if text:
        assert b"x-content-type-options: nosniff" in text.lower()


def test_few_descriptors_are_enough_and_the_log_stays_small(tmp_path: Path) -> None:
    """With 256 of them: before, `accept` failed for each of 600 connections, again and again, with a traceback each."""
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        started = live_service(tmp_path, with_worker=False)
        live = started.__enter__()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    try:
        resource.prlimit(live.api.pid, resource.RLIMIT_NOFILE, (256, 256))
        with ExitStack() as stack:
            for _ in range(600):
                stack.enter_context(live.connect()).sendall(HEAD)
            with live.client() as client:
                assert eventually(lambda: client.get("/healthz").status_code == 200, "an answer")
        assert len(live.log()) < 50_000
    finally:
        started.__exit__(None, None, None)
