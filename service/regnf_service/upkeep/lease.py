"""Leadership among processes that share a Redis: one at a time, for as long as it goes on saying so."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from redis import Redis

_TAKE = """
if redis.call('EXISTS', KEYS[1]) == 1 then return 0 end
local number = redis.call('INCR', KEYS[2])
redis.call('SET', KEYS[1], number, 'PX', ARGV[1])
return number
"""
_RENEW = "if redis.call('GET', KEYS[1]) == ARGV[1] then return redis.call('PEXPIRE', KEYS[1], ARGV[2]) end return 0"
_RELEASE = "if redis.call('GET', KEYS[1]) == ARGV[1] then return redis.call('DEL', KEYS[1]) end return 0"


class LeaseLostError(Exception):
    """Somebody else leads, or may: whoever hears this stops."""


class Term:
    """One term of leadership. Terms are numbered, and a later leader has a larger number."""

    def __init__(self, lease: Lease, number: int) -> None:
        self._lease = lease
        self.number = number

    def confirm(self) -> None:
        """Make sure before anything that cannot be undone. Raises LeaseLostError; otherwise the term goes on."""
        if not self._lease.renew(self.number):
            raise LeaseLostError(f"term {self.number} is over")


class Lease:
    """A lease by the name of ``key`` that lapses ``seconds`` after it was last confirmed."""

    def __init__(self, redis: Redis, key: str, seconds: float) -> None:
        self._key = key
        self._milliseconds = int(1000 * seconds)
        self._take = redis.register_script(_TAKE)
        self._renew = redis.register_script(_RENEW)
        self._release = redis.register_script(_RELEASE)

    @contextmanager
    def held(self) -> Iterator[Term | None]:
        """A term, if nobody else has one; it ends with the block."""
        number: Any = self._take(keys=[self._key, f"{self._key}:terms"], args=[self._milliseconds])
        try:
            yield Term(self, int(number)) if number else None
        finally:
            if number:
                self._release(keys=[self._key], args=[number])

    def renew(self, number: int) -> bool:
        return bool(self._renew(keys=[self._key], args=[number, self._milliseconds]))
