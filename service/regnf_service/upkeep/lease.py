"""Leadership among processes that share a Redis: one at a time, for as long as it keeps confirming."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

from redis import Redis
from redis.exceptions import LockError
from redis.lock import Lock


class LeaseLostError(Exception):
    """Another process leads, or may lead: stop."""


class Term:
    """One term of leadership. Terms are numbered, and a later leader has a larger number."""

    def __init__(self, lock: Lock, number: int) -> None:
        self._lock = lock
        self.number = number

    def confirm(self) -> None:
        """Call this before anything that cannot be undone: the term begins anew. Raises LeaseLostError."""
        try:
            self._lock.reacquire()
        except LockError as error:
            raise LeaseLostError(f"term {self.number} is over") from error


class Lease:
    """A lease named ``key`` that expires ``seconds`` after it was last confirmed."""

    def __init__(self, redis: Redis, key: str, seconds: float) -> None:
        self._redis = redis
        self._key = key
        self._seconds = seconds

    @contextmanager
    def held(self) -> Iterator[Term | None]:
        """A term, if no other process has one; it ends with the block."""
        lock = self._redis.lock(self._key, timeout=self._seconds, blocking=False, thread_local=False)
        if not lock.acquire():
            yield None
            return
        try:
            yield Term(lock, int(self._redis.incr(f"{self._key}:terms")))
        finally:
            with suppress(LockError):
                lock.release()
