"""Who has how many records, in Redis. Counted by the indexes that every release keeps.

Keys:  regnf:owners                   set of all who have had a record
       regnf:owner:{owner}:evicted    sorted by time: jobs that went to make room, the latest thousand
       regnf:owner:{owner}:{of}       sorted by time: a caller's short-lived keys of a kind, so that they are bounded
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from redis import Redis

from regnf_state.redis.documents import text
from regnf_state.redis.keys import PREFIX

OWNERS = f"{PREFIX}owners"
_JOBS = f"{PREFIX}jobs:created"
_FIELDS = f"{PREFIX}fields:created"
_ACTIVE = f"{PREFIX}jobs:active"
_FOUND = f"{PREFIX}owners:found"
_FIND_EVERY_S = 3600
_EVICTED_KEPT = 1000
_EVICTED_KEPT_S = 7 * 24 * 3600
_PAGE = 200
SHORT_LIVED = 10_000
"""Idempotency keys of one caller, and so on: beyond this the oldest goes before its time."""


class Owners:
    """The callers that one Redis knows."""

    def __init__(self, redis: Redis) -> None:
        self._redis = redis

    def all(self) -> list[str]:
        return sorted(map(text, self._redis.smembers(OWNERS)))

    def find(self) -> None:
        """Look for those that another release has not noted, once an hour."""
        if not self._redis.set(_FOUND, "1", nx=True, ex=_FIND_EVERY_S):
            return
        for index in (_JOBS, _FIELDS):
            names = [text(key).removeprefix(f"{index}:") for key in self._redis.scan_iter(f"{index}:*", count=1000)]
            if names:
                self._redis.sadd(OWNERS, *names)

    def finished(self, owner: str | None = None) -> int:
        """How many jobs that have ended an owner has; None: all together."""
        created = _JOBS if owner is None else f"{_JOBS}:{owner}"
        active = _ACTIVE if owner is None else f"{PREFIX}owner:{owner}:active"
        with self._redis.pipeline(transaction=False) as pipeline:
            pipeline.zcard(created)
            pipeline.scard(active)
            jobs, running = pipeline.execute()
        return int(jobs) - int(running)

    def held(self, owner: str) -> int:
        """How many records an owner has."""
        with self._redis.pipeline(transaction=False) as pipeline:
            for index in (_JOBS, _FIELDS):
                pipeline.zcard(f"{index}:{owner}")
            return sum(map(int, pipeline.execute()))

    def greediest(self, of: Callable[[str], int]) -> str | None:
        """Who has most; None when nobody has any."""
        most = max(((of(owner), owner) for owner in self.all()), default=(0, ""))
        return most[1] if most[0] > 0 else None

    def oldest_finished(self, owner: str, most: int) -> list[str]:
        """The ids of an owner's jobs that do not run or wait, those created first."""
        found: list[str] = []
        start = 0
        while len(found) < most:
            names: Any = self._redis.zrange(f"{_JOBS}:{owner}", start, start + _PAGE - 1)
            page = list(map(text, names))
            if not page:
                break
            active: Any = self._redis.smismember(_ACTIVE, page)
            found += [name for name, is_active in zip(page, active, strict=True) if not is_active]
            start += _PAGE
        return found[: max(0, most)]

    def note_evicted(self, owner: str, job_id: str) -> None:
        """So that whoever asks for it is told what became of it."""
        key = f"{PREFIX}owner:{owner}:evicted"
        seconds, _ = self._redis.time()
        with self._redis.pipeline() as pipeline:
            pipeline.zrem(f"{_JOBS}:{owner}", job_id)  # also where its record was gone, and named no owner
            pipeline.zadd(key, {job_id: seconds})
            pipeline.zremrangebyrank(key, 0, -_EVICTED_KEPT - 1)
            pipeline.expire(key, _EVICTED_KEPT_S)
            pipeline.execute()

    def was_evicted(self, owner: str, job_id: str) -> bool:
        return self._redis.zscore(f"{PREFIX}owner:{owner}:evicted", job_id) is not None

    def bound(self, owner: str, of: str, key: str, ttl_s: int) -> None:
        """Count a short-lived key as one of the owner's; the oldest beyond ten thousand are deleted."""
        index = f"{PREFIX}owner:{owner}:{of}"
        seconds, _ = self._redis.time()
        with self._redis.pipeline() as pipeline:
            pipeline.zadd(index, {key: seconds})
            pipeline.zremrangebyscore(index, "-inf", seconds - ttl_s)
            pipeline.expire(index, ttl_s)
            pipeline.zcard(index)
            held = pipeline.execute()[-1]
        if held > SHORT_LIVED:
            oldest: Any = self._redis.zpopmin(index, held - SHORT_LIVED)
            self._redis.delete(*(name for name, _ in oldest))
