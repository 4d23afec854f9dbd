"""A client for processes that answer requests: a call ends within four seconds, and fails at once after one that did.

Workers have the plain client: they wait for Redis, whose restart a job outlives.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from redis import Redis
from redis.backoff import ExponentialWithJitterBackoff
from redis.client import Pipeline
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError
from redis.retry import Retry

# A Redis that gives no answer is asked by one call at a time: all others fail at once, until it answers again.
#
# Made for a server that is frozen, not down: connections to it open, and nothing ever comes back. Each call that
# waits holds a thread. redis-py has a breaker for several databases only, and none that closes by a probe's late
# answer.

logger = logging.getLogger(__name__)


class CircuitOpenError(RedisConnectionError):
    """Redis did not answer a moment ago, and is not asked now."""


class CircuitBreaker:
    """Closed: calls go through. Open: one call in ``probe_every_s`` goes through. For any number of threads."""

    def __init__(self, probe_every_s: float = 0.5, clock: Callable[[], float] = time.monotonic) -> None:
        self._probe_every_s = probe_every_s
        self._clock = clock
        self._lock = threading.Lock()
        self._answered_at = clock()
        self._probe_at: float | None = None
        """Open since a call got no answer: when the next may try; infinite while one does."""

    @property
    def is_open(self) -> bool:
        return self._probe_at is not None

    @contextmanager
    def call(self) -> Iterator[bool]:
        """A call of the server, and whether it is a probe. Raises CircuitOpenError while the circuit is open."""
        with self._lock:
            began, is_probe = self._clock(), self._probe_at is not None
            if self._probe_at is not None and began < self._probe_at:
                raise CircuitOpenError("Redis does not answer")
            self._probe_at = math.inf if is_probe else None
        try:
            yield is_probe
        except (RedisConnectionError, RedisTimeoutError):
            self._failed(began, is_probe)
            raise
        except BaseException:  # tells nothing of the server's state but that it was refused
            if is_probe:
                self._answered()
            raise
        self._answered()

    def _answered(self) -> None:
        with self._lock:
            self._answered_at = self._clock()
            was_open, self._probe_at = self.is_open, None
        if was_open:
            logger.warning("Redis responds again")

    def _failed(self, began: float, is_probe: bool) -> None:
        """A call got no answer. Where others got theirs meanwhile, it was slow, and Redis is there."""
        with self._lock:
            opens = self._answered_at <= began and not self.is_open
            if opens or is_probe:
                self._probe_at = self._clock() + self._probe_every_s
        if opens:
            logger.warning("Redis does not respond: calls fail immediately until it does")


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


def _set_deadline(is_probe: bool) -> None:
    _running.deadline = time.monotonic() + (_SOCKET_TIMEOUT_S if is_probe else CALL_S)


class BoundedPipeline(Pipeline):
    """A pipeline whose calls go through a breaker."""

    breaker: CircuitBreaker

    def execute(self, raise_on_error: bool = True) -> list[Any]:
        with self.breaker.call() as is_probe:
            _set_deadline(is_probe)
            return super().execute(raise_on_error)


class BoundedRedis(Redis):
    """A client whose calls go through a breaker."""

    breaker: CircuitBreaker

    def execute_command(self, *args: Any, **options: Any) -> Any:
        with self.breaker.call() as is_probe:
            _set_deadline(is_probe)
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
