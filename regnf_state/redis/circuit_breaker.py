"""A Redis that gives no answer is asked by one call at a time: all others fail at once, until it answers again.

Made for a server that is frozen, not down: connections to it open, and nothing ever comes back. Each call that waits
holds a thread. redis-py has a breaker for several databases only, and none that closes by a probe's late answer.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError

logger = logging.getLogger(__name__)


class CircuitOpenError(RedisConnectionError):
    """Redis did not answer a moment ago, and is not asked now."""


@dataclass(frozen=True)
class Call:
    """One call that was let through."""

    began: float
    is_probe: bool


class CircuitBreaker:
    """Closed: calls go through. Open: one call in ``probe_every_s`` goes through. For any number of threads."""

    def __init__(self, probe_every_s: float = 0.5, clock: Callable[[], float] = time.monotonic) -> None:
        self._probe_every_s = probe_every_s
        self._clock = clock
        self._lock = threading.Lock()
        self._answered_at = clock()
        self._probe_at: float | None = None
        self._probing = False

    @property
    def is_open(self) -> bool:
        return self._probe_at is not None

    @contextmanager
    def call(self) -> Iterator[Call]:
        """A call of the server. Raises CircuitOpenError in its place while the circuit is open."""
        call = self._begin()
        try:
            yield call
        except (RedisConnectionError, RedisTimeoutError):
            self._failed(call)
            raise
        except BaseException:
            self._ended(call)
            raise
        self._answered()

    def _begin(self) -> Call:
        with self._lock:
            now = self._clock()
            if self._probe_at is None:
                return Call(now, is_probe=False)
            if self._probing or now < self._probe_at:
                raise CircuitOpenError("Redis does not answer")
            self._probing = True
            return Call(now, is_probe=True)

    def _answered(self) -> None:
        with self._lock:
            self._answered_at = self._clock()
            was_open, self._probe_at, self._probing = self.is_open, None, False
        if was_open:
            logger.warning("Redis answers again")

    def _failed(self, call: Call) -> None:
        """A call got no answer. Where others got theirs meanwhile, it was slow, and Redis is there."""
        with self._lock:
            opens = self._answered_at <= call.began and not self.is_open
            if opens or call.is_probe:
                self._probe_at = self._clock() + self._probe_every_s
            if call.is_probe:
                self._probing = False
        if opens:
            logger.warning("Redis does not answer: calls fail at once until it does")

    def _ended(self, call: Call) -> None:
        """A call ended for a reason that tells nothing of the server's state but that it was refused."""
        if call.is_probe:
            self._answered()
