"""The fair queue: callers take turns at the workers by the worker seconds that their work has cost.

Start-time fair queueing (Goyal, Vin and Cheng, 1996) over RQ's lists, see docs/adr/0009-fair-queue.md. The costs of a
piece of work are estimated when it is taken, as those of its caller's last work of its kind, and put right when it has
ended. A caller who was idle for long comes before those who were not, with a minute of work at most.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

from redis import Redis
from redis.client import Pipeline
from redis.exceptions import ResponseError

from regnf_state.queue import IMPORT_QUEUE_NAME, QUEUE_NAME, Work
from regnf_state.redis.counters import COUNTERS_KEY
from regnf_state.redis.documents import number, shown
from regnf_state.redis.fair_script import SCRIPT
from regnf_state.redis.unreadable import PREFIX

# How far a caller asks for more than its fair share of the workers.

_LATELY_S = 300
_LEAST_WEIGHT = 1e-6


def excess(redis: Redis, name: str) -> float:
    """Of the owner of this work: 0.0 for no more than the share, 1.0 for twice as much.

    What a caller asks for is what its work has cost the workers in the last minutes, this work included, and what its
    waiting work will cost by the estimate: of two who have a worker each, the one whose work never ends asks for more.
    Callers who have asked for nothing in the last minutes have no share, and a caller alone has no excess.
    """
    held: Any = redis.hget(f"{_PREFIX}entry:{name}", "owner")
    seconds, _ = redis.time()
    found: Any = redis.zrangebyscore(f"{_PREFIX}asked", seconds - _LATELY_S, seconds + _LATELY_S)
    owner, callers = shown(held or ""), sorted({shown(one) for one in found})
    if owner not in callers or len(callers) == 1:
        return 0.0
    with redis.pipeline(transaction=False) as pipeline:
        for caller in callers:
            _look_at(pipeline, caller)
        answers: list[Any] = pipeline.execute()
    rows = list(zip(answers[::4], answers[1::4], answers[2::4], answers[3::4], strict=True))
    asked = [_asked(spent, (seconds - _LATELY_S) // 60, waiting, costs) for spent, _, waiting, costs in rows]
    weights = [max(number(weight, 1.0), _LEAST_WEIGHT) for _, weight, _, _ in rows]
    own = callers.index(owner)
    share = math.fsum(asked) * weights[own] / math.fsum(weights)
    return max(0.0, asked[own] / share - 1.0) if share > 0 else 0.0


def _look_at(pipeline: Pipeline, caller: str) -> None:
    pipeline.hgetall(f"{_PREFIX}spent:{caller}")
    pipeline.hget(f"{_PREFIX}weights", caller)
    pipeline.llen(f"{_PREFIX}line:{caller}")
    pipeline.hmget(f"{_PREFIX}costs", f"{caller}|import", f"{caller}|registration")


def _asked(spent: dict[Any, Any], oldest: int, waiting: int, costs: list[Any]) -> float:
    """Worker seconds: those since the minute ``oldest``, and those of what waits, which may be of either kind."""
    had = math.fsum(number(seconds) for minute, seconds in spent.items() if number(minute) > oldest)
    known = [max(0.0, number(cost)) for cost in costs if cost is not None]
    return max(0.0, had) + waiting * (math.fsum(known) / len(known) if known else 0.0)


_PREFIX = f"{PREFIX}queue:"
_FIRST_COST_S = 10.0
"""What a caller's first work of a kind is taken to cost until it has run."""
_CREDIT_S = 60.0
"""How far behind the caller served last one may start that was idle: a few imports and a registration."""
_LISTS = tuple(f"rq:queue:{name}" for name in (IMPORT_QUEUE_NAME, QUEUE_NAME))
_NOT_DAMAGE = (
    "OOM",
    "MISCONF",
    "READONLY",
    "NOSCRIPT",
    "BUSY",
    "LOADING",
    "NOPERM",
    "MASTERDOWN",
    "NOREPLICAS",
    "denied",
)
"""What Redis says of a script that it does not run now, or not for us."""
_Value = TypeVar("_Value")
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Line:
    """What a caller has waiting. ``lead_s``: how far the caller has been served beyond the one served last."""

    owner: str
    waiting: int
    oldest_s: float
    lead_s: float


class Waiting(NamedTuple):
    """Work that is to wait, with what RQ holds of it. of_batch: whether it is of a batch."""

    work: Work
    owner: str
    payload: Mapping[str, Any]
    of_batch: bool = False


class FairQueue:
    """The waiting work of all callers. ``weights``: the shares of callers who have another one than 1. ``reserve_s``:
    how long after a caller's last request or result one worker stays free for it; 0: none does.
    """

    def __init__(self, redis: Redis, weights: Mapping[str, float] | None = None, reserve_s: float = 0.0) -> None:
        self._redis = redis
        self._weights = dict(weights or {})
        self._reserve_s = reserve_s
        self._script = redis.register_script(SCRIPT)

    def _step(self, step: str, name: str = "", *arguments: Any) -> int:
        """One step. Where the keys are damaged the queue begins anew, and the reaper queues what waited."""
        return self._mended(lambda: int(self._run(self._redis, step, name, *arguments)))

    def _run(self, client: Redis, step: str, name: str, *arguments: Any) -> Any:
        fixed: list[Any] = [step, name, _FIRST_COST_S, COUNTERS_KEY, _CREDIT_S, self._reserve_s]
        return self._script(keys=[_PREFIX], args=[*fixed, *arguments], client=client)

    def _mended(self, do: Callable[[], _Value]) -> _Value:
        """What ``do`` returns, on an empty queue if the keys of this one are damaged."""
        try:
            return do()
        except ResponseError as error:
            if not _tells_of_damage(error):
                raise
            logger.error("the fair queue is damaged and begins anew: %s", error)
        self._begin_anew()
        return do()

    def _begin_anew(self) -> None:
        """Drop every key that the script uses; of RQ's lists those of another type only."""
        damaged = [key for key in _LISTS if self._redis.type(key) != b"list"]
        held: list[Any] = [*self._redis.scan_iter(f"{_PREFIX}*", count=1000), *damaged]
        if held:
            self._redis.delete(*held)

    def enqueue(self, work: Work, owner: str, payload: Mapping[str, Any], of_batch: bool = False) -> bool:
        """Put work at the end of its owner's line, or before the jobs of batches there; False when it waits or runs
        already."""
        return self.enqueue_each([Waiting(work, owner, payload, of_batch)])[0]

    def enqueue_each(self, waiting: Iterable[Waiting]) -> list[bool]:
        """The same for several, in their order and in one round trip."""
        steps = [
            (
                one.work.name,
                *(one.owner, one.work.kind, self._weights.get(one.owner, 1.0), int(one.of_batch)),
                *(part for pair in one.payload.items() for part in pair),
            )
            for one in waiting
        ]
        return self._mended(lambda: self._enqueue(steps)) if steps else []

    def _enqueue(self, steps: Sequence[tuple[Any, ...]]) -> list[bool]:
        if len(steps) == 1:
            return [bool(self._run(self._redis, "enqueue", *steps[0]))]
        with self._redis.pipeline(transaction=False) as pipeline:
            for step in steps:
                self._run(pipeline, "enqueue", *step)
            answers = pipeline.execute(raise_on_error=False)
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
        return [bool(answer) for answer in answers]

    def turn(self) -> None:
        """See to it that the next in turn lies where workers take from."""
        self._step("turn")

    def holds(self, name: str) -> bool:
        """Whether work waits, or is being run by a worker that still reports."""
        return bool(self._step("holds", name))

    def remove(self, name: str) -> bool:
        """Take waiting work out; False when it does not wait."""
        return bool(self._step("remove", name))

    def finish(self, name: str, seconds: float) -> None:
        """Work that was taken has ended, and has cost so many worker seconds."""
        self._step("finish", name, f"{max(0.0, seconds):.6f}")

    def park(self, work: Work, owner: str, reference: str) -> None:
        """Have work that was taken wait for the import of a field, for nothing."""
        self._step("park", work.name, owner, work.kind, reference)

    def release(self, reference: str) -> None:
        """Put what waited for this field at the front of its line."""
        self._step("release", reference)

    def awaited(self) -> list[str]:
        """The fields that something waits for."""
        return sorted(
            shown(reference) for reference in self._mended(lambda: self._redis.smembers(f"{_PREFIX}parkings"))
        )

    def spent(self, owner: str) -> dict[int, float]:
        """An owner's worker seconds of the last hour by minute. What runs counts as the estimate says."""
        held: Any = self._mended(lambda: self._redis.hgetall(f"{_PREFIX}spent:{owner}"))
        oldest = int(self._redis.time()[0]) // 60 - 60
        minutes = {int(number(minute)): max(0.0, number(seconds)) for minute, seconds in held.items()}
        return {minute: seconds for minute, seconds in sorted(minutes.items()) if minute > oldest}

    def excess(self, name: str) -> float:
        """How far the owner of work asks for more than its fair share of the workers: ``fair_share.excess``."""
        return self._mended(lambda: excess(self._redis, name))

    def lines(self) -> list[Line]:
        """Every caller with work that waits, those whose turn is next first."""
        return self._mended(self._lines)

    def _lines(self) -> list[Line]:
        owners, ready, clock, now = self._look()
        with self._redis.pipeline(transaction=False) as pipeline:
            for owner, _ in owners:
                pipeline.llen(f"{_PREFIX}line:{owner}")
                pipeline.lindex(f"{_PREFIX}line:{owner}", 0)
            answers = pipeline.execute()
            for name in answers[1::2]:
                pipeline.hget(f"{_PREFIX}entry:{shown(name or '')}", "since")
            since = pipeline.execute()
        lines = [
            Line(owner, count + (owner == ready), max(0.0, now - number(begun, now)), number(tag) - clock)
            for (owner, tag), count, begun in zip(owners, answers[::2], since, strict=True)
        ]
        alone = ready is not None and all(owner != ready for owner, _ in owners)
        return [*([Line(ready, 1, 0.0, 0.0)] if ready is not None and alone else []), *lines]

    def _look(self) -> tuple[list[tuple[str, float]], str | None, float, float]:
        """The owners with their tags, the owner of what lies ready, the virtual clock, the server's time."""
        with self._redis.pipeline() as pipeline:
            pipeline.zrange(f"{_PREFIX}owners", 0, -1, withscores=True)
            pipeline.hmget(f"{_PREFIX}clock", "owner", "now")
            pipeline.llen(f"rq:queue:{IMPORT_QUEUE_NAME}")
            pipeline.llen(f"rq:queue:{QUEUE_NAME}")
            pipeline.time()
            owners, (ready, clock), imports, registrations, (seconds, _) = pipeline.execute()
        lies = ready is not None and imports + registrations > 0
        tags = [(shown(owner), number(tag)) for owner, tag in owners]
        return tags, shown(ready) if lies else None, number(clock), float(seconds)

    def position(self, work: Work) -> int | None:
        """The place of work in the order that is expected of what waits now; None when it is in no line."""
        return self._mended(lambda: self._position(work))

    def _position(self, work: Work) -> int | None:
        held: Any = self._redis.hget(f"{_PREFIX}entry:{work.name}", "owner")
        if held is None:
            return None
        mine = shown(held)
        with self._redis.pipeline(transaction=False) as pipeline:
            pipeline.lpos(f"{_PREFIX}line:{mine}", work.name)
            pipeline.lpos(f"rq:queue:{work.queue_name}", work.name)
            answers: list[int | None] = pipeline.execute()
        place, lies = answers
        if lies is not None:
            return lies + 1
        if place is None:
            return None
        owners, ready, _, _ = self._look()
        costs, lengths = self._costs([owner for owner, _ in owners])
        tags = dict(owners)
        mark = tags.get(mine, 0.0) + place * costs.get(mine, _FIRST_COST_S)
        others = (
            min(lengths[owner], max(0, math.ceil((mark - tag) / costs[owner])))
            for owner, tag in owners
            if owner != mine
        )
        return 1 + place + (ready is not None) + sum(others)

    def _costs(self, owners: list[str]) -> tuple[dict[str, float], dict[str, int]]:
        """What one registration of each owner moves its tag by, and the length of its line."""
        with self._redis.pipeline(transaction=False) as pipeline:
            for owner in owners:
                pipeline.hget(f"{_PREFIX}costs", f"{owner}|registration")
                pipeline.hget(f"{_PREFIX}weights", owner)
                pipeline.llen(f"{_PREFIX}line:{owner}")
            answers = pipeline.execute()
        rows = zip(owners, answers[::3], answers[1::3], strict=True)
        costs = {
            owner: max(number(cost, _FIRST_COST_S), 1e-3) / max(number(weight, 1.0), 1e-6)
            for owner, cost, weight in rows
        }
        return costs, dict(zip(owners, answers[2::3], strict=True))


def _tells_of_damage(error: ResponseError) -> bool:
    """Whether the script met a key of another type, or a value that it cannot reckon with: that stays until mended."""
    said = str(error)
    return ("WRONGTYPE" in said or "user_script" in said) and not any(word in said for word in _NOT_DAMAGE)
