"""How far a caller asks for more than its share of the workers."""

from __future__ import annotations

import pytest
from redis import Redis

from regnf_state.queue import Work
from regnf_state.redis.fair_queue import FairQueue


def measured(
    redis: Redis, used: dict[str, float], weights: dict[str, float] | None = None, ago_s: float = 0
) -> FairQueue:
    """A queue whose callers each have one job waiting, and have used so many worker seconds so long ago."""
    fair = FairQueue(redis, weights)
    minute = int(redis.time()[0] - ago_s) // 60
    for owner, seconds in used.items():
        fair.enqueue(work_of(owner), owner, {"owner": owner})
        redis.hset(f"regnf:queue:spent:{owner}", str(minute), seconds)
    return fair


def work_of(owner: str) -> Work:
    return Work("registration", owner, 1)


@pytest.mark.parametrize(
    ("used", "weights", "expected"),
    [
        ({"a": 100.0}, {}, 0.0),
        ({"a": 100.0, "b": 100.0}, {}, 0.0),
        ({"a": 50.0, "b": 100.0}, {}, 0.0),
        ({"a": 100.0, "b": 0.0}, {}, 1.0),
        ({"a": 100.0, "b": 50.0}, {}, 1 / 3),
        ({"a": 100.0, "b": 0.0, "c": 0.0}, {}, 2.0),
        ({"a": 75.0, "b": 25.0}, {"a": 3.0}, 0.0),
        ({"a": 50.0, "b": 50.0}, {"b": 3.0}, 1.0),
        ({"a": 0.0, "b": 0.0}, {}, 0.0),
        ({"a": -5.0, "b": 10.0}, {}, 0.0),
    ],
)
def test_excess_is_use_beyond_the_share(
    redis: Redis, used: dict[str, float], weights: dict[str, float], expected: float
) -> None:
    assert measured(redis, used, weights).excess(work_of("a").name) == pytest.approx(expected)


def test_what_waits_counts_by_what_such_work_has_cost(redis: Redis) -> None:
    """Both have had as much; one has work for nine times as long in its line."""
    fair = measured(redis, {"a": 20.0, "b": 20.0})
    for owner in "ab":
        redis.hset("regnf:queue:costs", f"{owner}|registration", 20.0)
    redis.rpush("regnf:queue:line:a", *range(6))
    assert fair.excess(work_of("b").name) == 0.0
    waiting = redis.llen("regnf:queue:line:a"), redis.llen("regnf:queue:line:b")
    asked = [20.0 + 20.0 * count for count in waiting]
    assert asked[0] > 2 * asked[1]
    assert fair.excess(work_of("a").name) == pytest.approx(2 * asked[0] / sum(asked) - 1)


def test_what_was_used_long_ago_does_not_count(redis: Redis) -> None:
    assert measured(redis, {"a": 100.0, "b": 1.0}, ago_s=420).excess(work_of("a").name) == 0.0


def test_callers_who_have_not_been_here_lately_have_no_share(redis: Redis) -> None:
    fair = measured(redis, {"a": 100.0, "b": 1.0})
    redis.zincrby("regnf:queue:asked", -400.0, "b")
    assert fair.excess(work_of("a").name) == 0.0


def test_work_that_is_not_known_has_no_excess(redis: Redis) -> None:
    assert measured(redis, {"a": 100.0, "b": 1.0}).excess("unknown-1") == 0.0


@pytest.mark.parametrize("value", [b"x", b"nan", b"inf", b"-inf", b"1e308", b"\xff"])
def test_odd_values_count_as_nothing(redis: Redis, value: bytes) -> None:
    fair = measured(redis, {"a": 100.0, "b": 1.0})
    redis.hset("regnf:queue:spent:b", value, value)
    redis.hset("regnf:queue:weights", "b", value)
    redis.zadd("regnf:queue:asked", {value: 1e12})
    assert 0.0 <= fair.excess(work_of("a").name) <= 2.0
