"""Receivers that take their time: none keeps another receiver, another caller or the service waiting."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial

import pytest
from redis import Redis

from regnf_service.webhooks import service
from regnf_service.webhooks.service import HttpSender, SendError, deliver_until_stopped, full
from regnf_service.webhooks.targets import AllowList, Webhooks, read_secrets
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.webhook_outbox import Message, RedisOutbox, line_of
from tests.service.conftest import SECRET, Receiver, delivery, finish

LONG_S = 60.0
Behavior = Callable[[socket.socket], object]


def nothing(connection: socket.socket) -> None:
    while connection.recv(4096):
        pass


def repeated(data: bytes, pause_s: float, first: bytes = b"") -> Behavior:
    def behave(connection: socket.socket) -> None:
        connection.sendall(first)
        while True:
            connection.sendall(data)
            time.sleep(pause_s)

    return behave


STATUS, EARLY = b"HTTP/1.1 200 OK\r\n", b"HTTP/1.1 103 Early Hints\r\nLink: </a>\r\n\r\n"
BEHAVIORS: dict[str, Behavior] = {
    "says nothing": nothing,
    "a byte of the status now and then": repeated(b"H", 0.05),
    "a byte of a header now and then": repeated(b"a", 0.05, STATUS + b"X: "),
    "headers without end": repeated(b"X: " + b"a" * 1000 + b"\r\n", 0.0, STATUS),
    "a header without end": repeated(b"a" * 1000, 0.0, STATUS + b"X: "),
    "interim answers without end": repeated(EARLY, 0.0),
    "interim answers now and then": repeated(EARLY, 0.05),
    "no HTTP without end": repeated(b"\0" * 1000, 0.0),
}


class Slow:
    def __init__(self, behave: Behavior) -> None:
        self._behave = behave
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self.opened = 0
        self.closed = threading.Semaphore(0)
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listening.accept()
            except OSError:
                return
            self.opened += 1
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            self._behave(connection)
        self.closed.release()

    def stop(self) -> None:
        self._listening.close()


@pytest.fixture
def slow(request: pytest.FixtureRequest) -> Iterator[Slow]:
    made = Slow(BEHAVIORS[getattr(request, "param", "says nothing")])
    yield made
    made.stop()


def send(url: str, timeout_s: float = 0.5) -> int:
    sender = HttpSender(AllowList(["127.0.0.1", "hooks.example"]).permits, timeout_s)
    return asyncio.run(asyncio.wait_for(sender.send(url, {}, b"{}"), LONG_S))


@pytest.mark.parametrize("scheme", ["http", "https"])
@pytest.mark.parametrize("slow", BEHAVIORS, indirect=True)
def test_a_send_ends_whatever_the_receiver_does(slow: Slow, scheme: str) -> None:
    with pytest.raises(SendError) as caught:
        send(f"{scheme}://127.0.0.1:{slow.port}/x")
    assert caught.value.reason in ("TIMEOUT", "ANSWER_TOO_LARGE", "CONNECTION_FAILED")
    assert slow.closed.acquire(timeout=LONG_S), "its connection is closed"


@pytest.mark.parametrize("length", [b"Content-Length: 99999999\r\n", b"Transfer-Encoding: chunked\r\n", b""])
def test_of_an_endless_body_nothing_is_read(length: bytes) -> None:
    slow = Slow(repeated(b"1\r\na\r\n", 0.0, STATUS + length + b"\r\n"))
    assert send(f"http://127.0.0.1:{slow.port}/x", LONG_S) == 200
    assert slow.closed.acquire(timeout=LONG_S)
    slow.stop()


def test_many_interim_answers_are_too_much_without_a_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = Slow(BEHAVIORS["interim answers without end"])
    with pytest.raises(SendError, match="ANSWER_TOO_LARGE"):
        send(f"http://127.0.0.1:{slow.port}/x", LONG_S)
    slow.stop()


def test_a_name_that_is_looked_up_for_ever_holds_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    over, asked = threading.Event(), []

    def look_up(*names: object, **_: object) -> list[object]:
        asked.append(names)
        over.wait(LONG_S)
        return []

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    sender = HttpSender(AllowList(["hooks.example"]).permits, 0.2)

    async def both() -> list[object]:
        sends = (sender.send("https://hooks.example/x", {}, b"{}") for _ in range(5))
        return await asyncio.wait_for(asyncio.gather(*sends, return_exceptions=True), LONG_S)

    assert [getattr(error, "reason", None) for error in asyncio.run(both())] == ["TIMEOUT"] * 5
    assert len(asked) == 1
    over.set()


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_receiver_that_does_not_answer_keeps_no_other_waiting(
    redis: Redis, receiver: Receiver, slow: Slow, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the same caller or of another; and the service ends while it does not answer."""
    monkeypatch.setattr(service, "HttpSender", partial(HttpSender, timeout_s=100 * LONG_S))
    hung = f"http://127.0.0.1:{slow.port}"
    for number in range(20):
        finish(redis, f"{hung}/x", name=f"hung{number}")
    finish(redis, receiver.address, name="own")
    finish(redis, receiver.address, name="other", owner="bob")
    secrets = read_secrets([f"alice:{SECRET}", f"bob:{SECRET}"])
    webhooks = Webhooks(AllowList([hung, receiver.address]), secrets, RedisOutbox(redis))

    async def serve() -> None:
        stopping = asyncio.Event()
        serving = asyncio.create_task(deliver_until_stopped(webhooks, RecordStore(redis), stopping))
        await asyncio.to_thread(until, lambda: slow.opened == 4 and len(receiver.received) == 2)
        assert not slow.closed.acquire(timeout=0)
        stopping.set()
        await asyncio.wait_for(serving, LONG_S)

    asyncio.run(serve())
    assert all(slow.closed.acquire(timeout=LONG_S) for _ in range(4))
    assert {delivery(redis, name=name).state for name in ("own", "other")} == {"delivered"}
    hanging = [delivery(redis, name=f"hung{number}") for number in range(20)]
    assert {(one.state, one.sends) for one in hanging} == {("pending", 0)}, "none is lost, and none counts as a send"


def test_lines_take_turns(redis: Redis) -> None:
    outbox = RedisOutbox(redis)
    for number in range(6):
        finish(redis, "https://a.example/x", name=f"a{number}")
    finish(redis, "https://B.example/y", name="b")
    finish(redis, "https://a.example/z", name="c", owner="bob")
    found = [outbox.claim() for _ in range(8)]
    assert {one.job_id for one in found[:3] if one is not None} == {"a0", "b", "c"}
    assert outbox.claim() is None
    assert outbox.waiting() == 8, "until they are settled"


def test_a_line_and_a_caller_have_a_share(redis: Redis) -> None:
    def message(number: int, url: str) -> Message:
        return Message(f"j{number}", 1, 0, line_of("alice", url))

    assert full([message(n, "https://a.example/x") for n in range(3)]) == []
    assert full([message(n, "https://A.example?x") for n in range(4)]) == ["alice a.example"]
    assert full([message(n, f"https://{n}.example/") for n in range(16)]) == ["alice"]
    finish(redis, "https://17.example/")
    finish(redis, "https://17.example/", name="j2", owner="bob")
    outbox = RedisOutbox(redis)
    assert [getattr(outbox.claim(["alice"]), "job_id", None) for _ in range(2)] == ["j2", None]
    assert outbox.claim(["alice a.example"]) is not None
