"""Clients that ask for more at once than they wait for: refused, so that others come to their turn."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial

import httpx
import pytest

from tests.contract.live import Live, eventually, live_service
from tests.contract.test_live_transport import submit
from tests.contract.world import ALICE, BOB, TOKENS, World, assert_refused

MOST = 8
REQUEST = b"GET /openapi.yaml HTTP/1.1\r\nHost: localhost\r\n\r\n"


@pytest.fixture
def limited(worlds: Callable[..., World]) -> Callable[..., World]:
    return partial(worlds, max_requests_per_caller=1)


@pytest.fixture(scope="module")
def narrow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A real API where an address has few requests in progress."""
    folder = tmp_path_factory.mktemp("narrow")
    with live_service(folder, with_worker=False, max_requests_per_caller=MOST) as started:
        yield started


def test_requests_at_once(limited: Callable[..., World]) -> None:
    world = limited(api_tokens=TOKENS)
    requests = world.app.state.services.requests
    with requests.held("alice"):
        refused = world.client.get("/fields", headers=ALICE)
        assert_refused(refused, 429, "TOO_MANY_REQUESTS_AT_ONCE")
        assert int(refused.headers["retry-after"]) > 0
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
        text = b"".join(iter(lambda: connection.recv(65536), b""))
    assert text.count(b"HTTP/1.1 200 ") == 31


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
