"""A client for processes that answer requests: a call ends within four seconds, and fails at once after one that did.

Workers have the plain client: they wait for Redis, whose restart a job outlives.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from redis import Redis
from redis.backoff import ExponentialWithJitterBackoff
from redis.client import Pipeline
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError
from redis.retry import Retry

from regnf_state.redis.circuit_breaker import Call, CircuitBreaker

CALL_S = 4.0
"""The most that one call takes, retries included."""
_SOCKET_TIMEOUT_S = 1.8
"""Time for one more attempt, after one that got no answer."""
_RETRIES = 20
_running = threading.local()


class _RetryInTime(Retry):
    """Tries again as long as an attempt that takes as long as the last one ends in time."""

    __hash__ = Retry.__hash__

    def call_with_retry(
        self,
        do: Callable[[], Any],
        fail: Callable[..., Any],
        is_retryable: Callable[[Exception], bool] | None = None,
        with_failure_count: bool = False,
    ) -> Any:
        deadline = getattr(_running, "deadline", None) or time.monotonic() + CALL_S
        failures = 0
        while True:
            began = time.monotonic()
            try:
                return do()
            except self._supported_errors as error:
                failures += 1
                fail(*((error, failures) if with_failure_count else (error,)))
                now, pause = time.monotonic(), self._backoff.compute(failures)
                in_time = now + pause + (now - began) < deadline
                if failures > self._retries or not in_time or (is_retryable and not is_retryable(error)):
                    raise
                time.sleep(pause)


def _set_deadline(call: Call) -> None:
    """Of what the calling thread does next. A probe is one attempt."""
    _running.deadline = time.monotonic() + (_SOCKET_TIMEOUT_S if call.is_probe else CALL_S)


class BoundedPipeline(Pipeline):
    """A pipeline whose calls go through a breaker."""

    breaker: CircuitBreaker

    def execute(self, raise_on_error: bool = True) -> list[Any]:
        with self.breaker.call() as call:
            _set_deadline(call)
            return super().execute(raise_on_error)


class BoundedRedis(Redis):
    """A client whose calls go through a breaker."""

    breaker: CircuitBreaker

    def execute_command(self, *args: Any, **options: Any) -> Any:
        with self.breaker.call() as call:
            _set_deadline(call)
            return super().execute_command(*args, **options)  # type: ignore[no-untyped-call]

    def pipeline(self, transaction: bool = True, shard_hint: str | None = None) -> BoundedPipeline:
        made = BoundedPipeline(self.connection_pool, self.response_callbacks, transaction, shard_hint)
        made.breaker = self.breaker
        return made


def connect_bounded(url: str) -> BoundedRedis:
    """A client for redis://, rediss:// or unix:// addresses. Connects on first use."""
    client = BoundedRedis.from_url(
        url,
        socket_timeout=_SOCKET_TIMEOUT_S,
        socket_connect_timeout=_SOCKET_TIMEOUT_S,
        health_check_interval=30,
        retry=_RetryInTime(ExponentialWithJitterBackoff(cap=1.0, base=0.1), _RETRIES),
        retry_on_error=[RedisConnectionError, RedisTimeoutError],
    )
    assert isinstance(client, BoundedRedis)
    client.breaker = CircuitBreaker()
    return client
