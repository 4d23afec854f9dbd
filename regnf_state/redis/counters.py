"""Counters of what happens to jobs and fields, in Redis. A counter changes in the same step as the record it is about.

So an event counts once, whichever process causes it, and no count is lost when a process ends. A counter is a field of
one hash: its name and the values of its labels, joined by a bar. Times are counted in buckets with fixed upper bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from redis import Redis
from redis.exceptions import ResponseError

from regnf_state.records import ACTIVE, FieldRecord, JobRecord
from regnf_state.redis.documents import Command, owned_key, shown, text
from regnf_state.redis.unreadable import PREFIX

COUNTERS_KEY = f"{PREFIX}counters"
BOUNDS_S = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 60.0, 120.0, 300.0, 900.0)


def counted(name: str, *labels: str, by: int = 1) -> Command:
    return ("HINCRBY", COUNTERS_KEY, "|".join((name, *labels)), str(by))


def count(redis: Redis, name: str, *labels: str) -> None:
    """Count one that is no part of a change. Counters that are no hash, or no number, begin again."""
    counter = "|".join((name, *labels))
    try:
        redis.hincrby(COUNTERS_KEY, counter, 1)
    except ResponseError as error:
        if "WRONGTYPE" in str(error):
            redis.delete(COUNTERS_KEY)
        elif "not an integer" in str(error) or "overflow" in str(error):
            redis.hdel(COUNTERS_KEY, counter)
        else:
            raise
        redis.hincrby(COUNTERS_KEY, counter, 1)


def timed(name: str, seconds: float, *labels: str) -> list[Command]:
    """One observation: its bucket, and what it adds to the sum. A clock that was set back counts as no time."""
    seconds = max(0.0, seconds)
    bound = next((str(bound) for bound in BOUNDS_S if seconds <= bound), "+Inf")
    return [
        counted(name, *labels, bound),
        ("HINCRBYFLOAT", COUNTERS_KEY, "|".join((name, *labels, "sum")), f"{seconds:.6f}"),
    ]


def of_job(before: JobRecord | None, after: JobRecord) -> list[Command]:
    """What a job's change adds. Its time is the record's own: ``updated``."""
    if before is None or before.attempt != after.attempt:
        return [counted("job_attempts")]
    now, commands = after.updated, []
    if (before.phase, before.status) != (after.phase, after.status) and before.phase and before.phase_since:
        commands += timed("job_phase_seconds", now - before.phase_since, before.phase)
    if before.status == "accepted" and after.status == "running":
        commands += timed("job_wait_seconds", now - before.updated)
    if before.status in ACTIVE and after.status not in ACTIVE:
        reason = str((after.error or {}).get("reason", ""))
        commands.append(counted("jobs_finished", after.status, after.verdict or "", reason))
        if after.started is not None:
            commands += timed("job_run_seconds", now - after.started, after.status)
    return commands


def of_field(before: FieldRecord | None, after: FieldRecord) -> list[Command]:
    """What a field's change adds: an import that has ended."""
    if before is None or before.state != "validating" or after.state == "validating":
        return []
    reason = str((after.error or {}).get("reason", ""))
    return [counted("imports", after.state, reason), *timed("import_seconds", after.updated - before.updated)]


class Counters:
    """All counters as they were at one moment."""

    def __init__(self, redis: Redis) -> None:
        held: Any = _held(redis)
        self._held = {tuple(shown(name).split("|")): _number(shown(value)) for name, value in held.items()}

    def counts(self, name: str) -> Iterable[tuple[Sequence[str], float]]:
        """(labels, value) of each count."""
        return [(labels[1:], value) for labels, value in sorted(self._held.items()) if labels[0] == name]

    def times(self, name: str) -> Iterable[tuple[Sequence[str], list[tuple[str, float]], float]]:
        """(labels, cumulative counts by upper bound, sum) of each group of times."""
        groups = sorted({labels[1:-1] for labels in self._held if labels[0] == name})
        for group in groups:
            buckets, total = [], 0.0
            for bound in (*map(str, BOUNDS_S), "+Inf"):
                total += self._held.get((name, *group, bound), 0.0)
                buckets.append((bound, total))
            yield group, buckets, self._held.get((name, *group, "sum"), 0.0)


def _held(redis: Redis) -> Any:
    """Nothing where the counters are no hash: the next event begins them again."""
    try:
        return redis.hgetall(COUNTERS_KEY)
    except ResponseError as error:
        if "WRONGTYPE" not in str(error):
            raise
        return {}


def _number(value: str) -> float:
    """What was counted; 0 for what is no number: a damaged count must not hide the others."""
    try:
        return float(value)
    except ValueError:
        return 0.0


# Who has how many records, in Redis. Counted by the indexes that every release keeps.
#
# Keys:  regnf:owners                   set of all who have had a record
#        regnf:owner:{owner}:evicted    sorted by time: jobs that went to make room, the latest thousand
#        regnf:owner:{owner}:{of}       sorted by time: a caller's short-lived keys of a kind, so that they are
#   bounded

OWNERS = f"{PREFIX}owners"
_JOBS = f"{PREFIX}jobs:created"
_FIELDS = f"{PREFIX}fields:created"
_ACTIVE = f"{PREFIX}jobs:active"
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

    def finished(self, owner: str | None = None) -> int:
        """How many jobs that have ended an owner has; None: all together."""
        created = _JOBS if owner is None else f"{_JOBS}:{owner}"
        active = _ACTIVE if owner is None else owned_key(owner, "active")
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
        key = owned_key(owner, "evicted")
        seconds, _ = self._redis.time()
        with self._redis.pipeline() as pipeline:
            pipeline.zrem(f"{_JOBS}:{owner}", job_id)  # also where its record was gone, and named no owner
            pipeline.zadd(key, {job_id: seconds})
            pipeline.zremrangebyrank(key, 0, -_EVICTED_KEPT - 1)
            pipeline.expire(key, _EVICTED_KEPT_S)
            pipeline.execute()

    def was_evicted(self, owner: str, job_id: str) -> bool:
        return self._redis.zscore(owned_key(owner, "evicted"), job_id) is not None

    def bound(self, owner: str, of: str, key: str, ttl_s: int) -> None:
        """Count a short-lived key as one of the owner's; the oldest beyond ten thousand are deleted."""
        index = owned_key(owner, of)
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
