"""A Redis that gives no answer: by a clock that the test moves, and with a real server that is stopped."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager

import pytest
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import RedisError, ResponseError
from redis.exceptions import TimeoutError as RedisTimeoutError

from regnf_state.redis import bounded_client
from regnf_state.redis.bounded_client import BoundedRedis, CircuitBreaker, CircuitOpenError, connect_bounded
from tests.restartable_redis import restartable_redis


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def breaker(clock: Clock) -> CircuitBreaker:
    made = CircuitBreaker(probe_every_s=0.5, clock=clock)
    clock.now = 1.0
    return made


def fail(breaker: CircuitBreaker, error: type[Exception] = RedisTimeoutError) -> None:
    with pytest.raises(error), breaker.call():
        raise error("no answer")


def answer(breaker: CircuitBreaker) -> bool:
    """A call that Redis answers; whether it was let through."""
    try:
        with breaker.call():
            return True
    except CircuitOpenError:
        return False


@pytest.mark.parametrize("error", [RedisTimeoutError, RedisConnectionError])
def test_after_a_call_without_answer_all_fail_at_once(breaker: CircuitBreaker, error: type[Exception]) -> None:
    assert answer(breaker)
    fail(breaker, error)
    assert not answer(breaker)
    with pytest.raises(RedisError), breaker.call():
        pytest.fail("it was let through")


def test_one_call_at_a_time_asks_again(breaker: CircuitBreaker, clock: Clock) -> None:
    fail(breaker)
    clock.now += 0.6
    with breaker.call() as probe:
        assert probe
        assert not answer(breaker), "one at a time"
        clock.now += 60.0
        assert not answer(breaker)
    assert answer(breaker), "the probe was answered"
    assert not breaker.is_open


def test_a_probe_without_answer_keeps_it_open(breaker: CircuitBreaker, clock: Clock) -> None:
    fail(breaker)
    clock.now += 0.6
    fail(breaker)
    assert not answer(breaker)
    clock.now += 0.6
    assert answer(breaker)


def test_a_refusal_is_an_answer(breaker: CircuitBreaker, clock: Clock) -> None:
    fail(breaker, ResponseError)
    assert answer(breaker)
    fail(breaker)
    clock.now += 0.6
    fail(breaker, ResponseError)
    assert answer(breaker)


def _end(call: AbstractContextManager[bool], error: Exception) -> None:
    """The call gets no answer."""
    call.__exit__(type(error), error, None)


def test_one_slow_call_among_others_that_are_answered_opens_nothing(breaker: CircuitBreaker, clock: Clock) -> None:
    slow = breaker.call()
    slow.__enter__()
    clock.now += 1.0
    assert answer(breaker)
    _end(slow, RedisTimeoutError())
    assert answer(breaker)


def test_a_call_that_began_before_is_no_probe(breaker: CircuitBreaker, clock: Clock) -> None:
    slow = breaker.call()
    slow.__enter__()
    fail(breaker)
    clock.now += 0.6
    with breaker.call() as probe:
        assert probe
        _end(slow, RedisTimeoutError())
        clock.now += 0.6
        assert not answer(breaker), "the probe is still on its way"


def test_many_threads_send_one_probe(breaker: CircuitBreaker, clock: Clock) -> None:
    fail(breaker)
    clock.now += 0.6
    together, through = threading.Barrier(16), []

    def ask() -> None:
        together.wait()
        try:
            with breaker.call() as call:
                through.append(call)
                held.wait(10)
        except CircuitOpenError:
            refused.release()

    held, refused = threading.Event(), threading.Semaphore(0)
    threads = [threading.Thread(target=ask) for _ in range(16)]
    for thread in threads:
        thread.start()
    assert all(refused.acquire(timeout=10) for _ in range(15))
    held.set()
    for thread in threads:
        thread.join()
    assert len(through) == 1


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_client, "_SOCKET_TIMEOUT_S", 0.2)
    monkeypatch.setattr(bounded_client, "CALL_S", 0.5)


def _script(redis: BoundedRedis) -> Callable[[], object]:
    return redis.register_script("return redis.call('GET', 'key')")


def _pipeline(redis: BoundedRedis) -> Callable[[], object]:
    def run() -> object:
        with redis.pipeline(transaction=False) as pipeline:
            pipeline.get("key")
            return pipeline.execute()[0]

    return run


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("make", [lambda redis: lambda: redis.get("key"), _script, _pipeline])
def test_a_server_that_is_stopped(make: Callable[[BoundedRedis], Callable[[], object]]) -> None:
    with restartable_redis() as server, connect_bounded(server.url) as redis:
        redis.set("key", "value")
        call = make(redis)
        assert call() == b"value"
        assert server.process is not None
        server.process.send_signal(signal.SIGSTOP)
        try:
            with pytest.raises((RedisTimeoutError, RedisConnectionError)):
                call()
            assert redis.breaker.is_open
            with pytest.raises(CircuitOpenError):
                call()
        finally:
            server.process.send_signal(signal.SIGCONT)
        redis.breaker._probe_at = 0.0
        assert call() == b"value"
        assert not redis.breaker.is_open


def test_a_restart_of_the_server_is_waited_for() -> None:
    with restartable_redis() as server, connect_bounded(server.url) as redis:
        redis.set("key", "value")
        server.kill()
        starting = threading.Timer(0.5, server.start)
        starting.start()
        assert redis.get("key") == b"value"
        starting.join()
        assert not redis.breaker.is_open
