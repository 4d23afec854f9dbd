"""How far a caller asks for more than its fair share of the workers."""

from __future__ import annotations

import math
from typing import Any

from redis import Redis
from redis.client import Pipeline

from regnf_state.redis.documents import number, shown
from regnf_state.redis.keys import PREFIX

_PREFIX = f"{PREFIX}queue:"
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
