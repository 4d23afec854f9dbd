"""Clients that ask for more at once than they wait for: refused, so that others come to their turn."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial

import httpx
import pytest

from tests.contract.live import Live, eventually, live_service
from tests.contract.test_slow_clients import ended, submit
from tests.contract.world import ALICE, BOB, TOKENS, World, assert_refused, field_bytes, sha256

MOST = 8
REQUEST = b"GET /openapi.yaml HTTP/1.1\r\nHost: localhost\r\n\r\n"


@pytest.fixture
def limited(worlds: Callable[..., World]) -> Callable[..., World]:
    """Makes a service where a caller has one request in progress."""
    return partial(worlds, max_requests_per_caller=1)


@pytest.fixture(scope="module")
def narrow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A real API where an address has few requests in progress."""
    folder = tmp_path_factory.mktemp("narrow")
    limits = {
        "max_requests_per_caller": MOST, "max_connections": 3 * MOST, "max_connections_per_address": 2 * MOST,
        "max_uploads_per_caller": 3,
    }  # fmt: skip
    with live_service(folder, with_worker=False, **limits) as started:
        yield started


def test_requests_at_once(limited: Callable[..., World]) -> None:
    world = limited(api_tokens=TOKENS)
    requests = world.app.state.services.requests
    with requests.held("alice"):
        refused = world.client.get("/fields", headers=ALICE)
        assert_refused(refused, 429, "TOO_MANY_REQUESTS_AT_ONCE")
        assert (int(refused.headers["retry-after"]) > 0, refused.headers["connection"]) == (True, "close")
        assert world.client.get("/healthz", headers=ALICE).status_code == 200
        assert world.client.get("/static/favicon.svg", headers=ALICE).status_code == 200
        assert_refused(world.client.get("/fields"), 401, "UNAUTHENTICATED")
        assert world.client.get("/fields", headers=BOB).status_code == 200
    for path in ("/fields", "/nowhere", "/fields?what=1"):
        assert world.client.get(path, headers=ALICE).status_code != 429
    assert requests.taken == 0, "places are given back, by a refused request too"


def test_without_tokens_each_address_has_its_own(limited: Callable[..., World]) -> None:
    world = limited()
    with world.app.state.services.requests.held("anonymous 127.0.0.1"):
        assert_refused(world.client.get("/fields"), 429, "TOO_MANY_REQUESTS_AT_ONCE")
    with world.app.state.services.requests.held("anonymous 127.0.0.2"):
        assert world.client.get("/fields").status_code == 200


def test_held_answers_of_one_address_shut_no_other_out(narrow: Live) -> None:
    """As many as it may have connections; those beyond the limit are refused and closed, so that there is room."""
    with narrow.client() as client, ExitStack() as stack:
        job = submit(client)
        request = f"GET /jobs/{job}?wait=30 HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
        held = []
        for address in ("127.0.0.2", "127.0.0.3"):
            for _ in range(2 * MOST):
                one = stack.enter_context(
                    socket.create_connection(("127.0.0.1", narrow.port), timeout=20, source_address=(address, 0))
                )
                one.sendall(request)
                held.append(one)
        with narrow.client() as honest:
            assert eventually(lambda: answered(honest, f"/jobs/{job}"), "an answer", 10)
        refused = [text for text in map(at_hand, held) if b"TOO_MANY_REQUESTS_AT_ONCE" in text]
        assert len(refused) >= MOST
        client.post(f"/jobs/{job}/cancel")


def answered(client: httpx.Client, path: str) -> bool:
    try:
        return client.get(path, timeout=5).status_code == 200
    except httpx.TransportError:
        return False


def at_hand(connection: socket.socket) -> bytes:
    connection.setblocking(False)
    try:
        return connection.recv(65536)
    except OSError:
        return b""


def test_requests_sent_ahead_are_answered_one_after_the_other(narrow: Live) -> None:
    last = REQUEST.replace(b"localhost\r\n", b"localhost\r\nConnection: close\r\n")
    with narrow.connect() as connection:
        connection.sendall(REQUEST * 30 + last)
        assert ended(connection).count(b"HTTP/1.1 200 ") == 31


def test_connections_that_ask_ahead_make_room(narrow: Live) -> None:
    """As many as an address may have, each with something to answer all the time, and a client that does not read."""
    with ExitStack() as stack:
        for _ in range(2 * MOST):
            stack.enter_context(narrow.connect()).sendall(REQUEST * 200)
        with narrow.client() as honest:
            assert eventually(lambda: answered(honest, "/version"), "an answer", 10)


def test_a_client_does_not_choose_the_address_it_counts_for(narrow: Live) -> None:
    with narrow.client() as client, ExitStack() as stack:
        job = submit(client)
        held = []
        for number in range(2 * MOST):
            head = f"GET /jobs/{job}?wait=30 HTTP/1.1\r\nHost: localhost\r\nX-Forwarded-For: 10.0.0.{number}\r\n\r\n"
            one = stack.enter_context(
                socket.create_connection(("127.0.0.1", narrow.port), timeout=20, source_address=("127.0.0.4", 0))
            )
            one.sendall(head.encode())
            held.append(one)
        refused = 0

        def all_refused() -> bool:
            nonlocal refused
            refused += sum(b"TOO_MANY_REQUESTS_AT_ONCE" in at_hand(one) for one in held)
            return refused >= MOST

        assert eventually(all_refused, "the refusals", 10)
        client.post(f"/jobs/{job}/cancel")


def test_slow_uploads_make_room_for_another_of_the_same_address(narrow: Live) -> None:
    """Each would have half a minute for its next byte, if nobody else asked."""
    data = field_bytes("honest beside slow uploads", 1 << 20)
    with ExitStack() as stack, narrow.client() as honest:
        slow = [stack.enter_context(narrow.connect()) for _ in range(3)]
        for one in slow:
            one.sendall(b"POST /fields HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4000000\r\n\r\n" + data[:600])
        assert honest.put(f"/fields/{sha256(data)}", content=data).status_code == 201
        assert honest.delete(f"/fields/{sha256(data)}").status_code == 204
        told = [text for text in map(at_hand, slow) if text]
    assert len(told) == 1
    assert b"REQUEST_STALLED" in told[0]
