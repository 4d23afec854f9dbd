"""How often a caller may ask for a change, and what it is told beyond that."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator

import httpx
import pytest
from starlette.types import Message, Receive, Scope, Send

from regnf_service.http import rate_limits
from regnf_service.http.middleware import Buckets
from regnf_service.http.rate_limits import WriteGate
from regnf_state.settings import Settings
from tests.contract.live import Live, live_service
from tests.contract.world import ALICE, BOB, NOBODY, TOKENS, World, assert_refused, field_bytes, sha256

WRITES = [
    ("POST", "/register"), ("POST", "/v1/register"), ("POST", "/fields"), ("PUT", f"/fields/{'0' * 64}"),
    ("PATCH", f"/fields/{'0' * 64}"), ("DELETE", f"/fields/{'0' * 64}"), ("POST", f"/jobs/{NOBODY}/cancel"),
    ("DELETE", f"/jobs/{NOBODY}"), ("POST", "/nowhere"), ("BREW", "/coffee"),
]  # fmt: skip
READS = ["/", "/fields", "/jobs", f"/jobs/{NOBODY}", "/version", "/openapi.yaml", "/healthz"]


@pytest.fixture
def limited(worlds: Callable[..., World]) -> Callable[..., World]:
    """Makes a service where two writes empty a bucket for minutes."""
    slow = {"write_limit_per_s": 0.01, "write_limit_burst": 2}
    return lambda **settings: worlds(**(slow | settings))


@pytest.fixture(scope="module")
def hurried(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A real API where an address has had all its writes."""
    folder = tmp_path_factory.mktemp("hurried")
    with live_service(folder, with_worker=False, write_limit_per_s=0.001, write_limit_burst=1) as started:
        with started.client() as client:
            assert client.delete("/nothing").status_code != 429
        yield started


def assert_too_many(answer: httpx.Response) -> None:
    assert_refused(answer, 429, "TOO_MANY_WRITES")
    assert 90 < int(answer.headers["retry-after"]) <= 100


@pytest.mark.parametrize(("method", "path"), WRITES)
def test_a_hasty_callers_writes_are_refused_and_its_reads_are_not(
    limited: Callable[..., World], method: str, path: str
) -> None:
    world = limited(api_tokens=TOKENS)
    for _ in range(2):
        assert world.client.request(method, path, headers=ALICE).status_code != 429
    assert_too_many(world.client.request(method, path, headers=ALICE))
    assert {world.client.get(read, headers=ALICE).status_code for read in READS} <= {200, 404}
    assert world.client.request(method, path, headers=BOB).status_code != 429, "another caller's writes are its own"
    assert_refused(world.client.request(method, path), 401, "UNAUTHENTICATED")


def test_nothing_is_done_and_the_same_is_taken_later(limited: Callable[..., World]) -> None:
    world = limited(api_tokens=TOKENS)
    data = field_bytes("a")
    sent = {"url": f"/fields/{sha256(data)}", "content": data, "headers": ALICE}
    for _ in range(2):
        world.client.delete("/nothing", headers=ALICE)
    assert_too_many(world.client.put(**sent))
    assert_refused(world.client.get(sent["url"], headers=ALICE), 404, "FIELD_NOT_FOUND")
    assert not world.blobs.blobs
    assert world.client.put(**(sent | {"headers": BOB})).status_code == 201


def test_registrations_and_their_cancels_count_alike(limited: Callable[..., World]) -> None:
    world = limited(write_limit_burst=6)
    first = world.submit(seed=1)  # the third: two uploads came first
    assert world.submit(seed=1) == first, "the same again is one job, and one write more"
    assert world.client.post(f"/jobs/{first}/cancel").status_code == 202
    assert world.client.delete(f"/jobs/{first}").status_code == 204
    assert_too_many(world.client.post("/register", json=world.valid_request() | {"seed": 2}))
    assert_too_many(world.client.post("/register", content=b"no JSON"))
    assert world.queue.registrations == []


def test_without_tokens_each_address_has_its_own(limited: Callable[..., World]) -> None:
    world = limited()
    gate = _gate_of(world)
    for _ in range(2):
        gate._buckets.take("anonymous 127.0.0.1")
    assert_too_many(world.client.post("/register"))
    gate._buckets._held.clear()
    for _ in range(2):
        gate._buckets.take("anonymous 127.0.0.2")
    assert world.client.post("/register").status_code == 415


def _gate_of(world: World) -> WriteGate:
    """The one in use, found from outside to inside."""
    at = world.app.middleware_stack or world.app.build_middleware_stack()
    world.app.middleware_stack = at
    while not isinstance(at, WriteGate):
        at = getattr(at, "_app", None) or at.app  # type: ignore[union-attr]
    return at


def test_a_refusal_reads_nothing() -> None:
    asked, answers = [], []

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        asked.append(scope["path"])

    async def receive() -> Message:
        raise AssertionError("the body was read")

    async def send(message: Message) -> None:
        answers.append(message)

    gate = WriteGate(app, Buckets(1.0, 1, lambda: 0.0))
    scope = {"type": "http", "method": "POST", "path": "/x", "headers": [], "state": {"caller": "alice"}}
    for path in ("/first", "/second"):
        asyncio.run(gate(scope | {"path": path}, receive, send))
    assert asked == ["/first"]
    assert answers[0]["status"] == 429


@pytest.mark.parametrize("wait_s", [1e-300, 5e-324])
def test_no_rate_is_too_slow_for_an_answer(limited: Callable[..., World], wait_s: float) -> None:
    world = limited(write_limit_per_s=wait_s, write_limit_burst=1)
    world.client.post("/register")
    refused = world.client.post("/register")
    assert_refused(refused, 429, "TOO_MANY_WRITES")
    assert refused.headers["retry-after"] == "3600"


@pytest.mark.parametrize(
    ("host", "tokens", "given", "rate"),
    [
        ("127.0.0.1", (), None, 0), ("127.0.0.1", TOKENS, None, 10), ("0.0.0.0", (), None, 10),
        ("0.0.0.0", TOKENS, 0, 0), ("localhost", (), 3, 3),
    ],
)  # fmt: skip
def test_without_a_word_who_is_alone_has_no_rate(host: str, tokens: frozenset[str], given: float, rate: float) -> None:
    assert Settings(host=host, api_tokens=tokens, write_limit_per_s=given).writes_per_s == rate


# the connection


def test_a_refused_write_leaves_its_connection_open(hurried: Live) -> None:
    """A client that is to wait a second and try again need not connect anew; what it has sent is dropped."""
    small = b"POST /register HTTP/1.1\r\nHost: localhost\r\nContent-Length: 60000\r\n\r\n" + b"x" * 60000
    last = b"GET /version HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
    answers = _exchange(hurried, small * 4 + last)
    assert answers.count(b"HTTP/1.1 429 ") == 4
    assert answers.count(b"HTTP/1.1 200 ") == 1


@pytest.mark.parametrize(
    "lines",
    ["Content-Length: 4000000", "Transfer-Encoding: chunked", "Content-Length: 60000\r\nExpect: 100-continue"],
)
def test_who_would_send_much_is_told_before_and_the_connection_closed(hurried: Live, lines: str) -> None:
    answers = _exchange(hurried, f"POST /fields HTTP/1.1\r\nHost: localhost\r\n{lines}\r\n\r\n".encode())
    assert answers.startswith(b"HTTP/1.1 429 ")
    assert b"connection: close" in answers.lower()


def _exchange(service: Live, sent: bytes) -> bytes:
    """Everything that is answered until the service closes the connection."""
    with service.connect() as connection:
        connection.sendall(sent)
        return b"".join(iter(lambda: connection.recv(65536), b""))


def test_refusals_that_come_too_often_are_held_back(monkeypatch: pytest.MonkeyPatch) -> None:
    held: list[float] = []

    async def hold(seconds: float) -> None:
        held.append(seconds)

    async def nothing(*_given: object) -> None:
        return None

    monkeypatch.setattr("regnf_service.http.rate_limits.asyncio.sleep", hold)
    gate = WriteGate(nothing, Buckets(0.01, 1))
    scope: Scope = {"type": "http", "method": "POST", "path": "/register", "headers": []}

    def ask(caller: str) -> int:
        asyncio.run(gate(scope | {"state": {"caller": caller}}, nothing, nothing))  # type: ignore[arg-type]
        return len(held)

    assert [ask("alice") for _ in range(21)][-1] == 0, "the first ones at once"
    assert [ask("alice") for _ in range(3)] == [1, 2, 3]
    assert [ask("bob") for _ in range(2)][-1] == 3, "another caller's are its own"
    assert set(held) == {rate_limits._HELD_S}
