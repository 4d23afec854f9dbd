"""A fair queue with keys and values that nobody of ours has written goes on, empty if need be."""

from __future__ import annotations

import re

import pytest
from redis import Redis
from redis.exceptions import ResponseError

from regnf_state.queue import Work
from regnf_state.redis.counters import COUNTERS_KEY, Counters, count
from regnf_state.redis.fair_queue import FairQueue, Waiting

PREFIX = "regnf:queue:"
WAITING, OTHER, PARKED = (Work("registration", f"{letter * 32}", 1) for letter in "abc")
ODD = [b"x", b"", b"nan", b"inf", b"-inf", b"1e308", b"0", b"-1", b"\xff\xfe", b"9" * 400]


def used(redis: Redis) -> FairQueue:
    """A queue with something in every key: work that waits, lies ready, has been run and is parked."""
    fair = FairQueue(redis)
    for number in range(3):
        fair.enqueue(Waiting(Work("registration", f"{number:032x}", 1), "one", {"owner": "one"}))
    fair.enqueue(Waiting(WAITING, "two", {"owner": "two"}))
    redis.lpop("rq:queue:regnf")
    fair.turn()
    fair.park(PARKED, "one", "e" * 64)
    return fair


def go_through(fair: FairQueue, redis: Redis) -> None:
    """All that API, workers and reaper ask of the queue."""
    fair.turn()
    fair.holds(WAITING.name)
    fair.position(WAITING)
    fair.lines()
    fair.release("e" * 64)
    fair.awaited()
    Counters(redis)
    redis.lpop("rq:queue:regnf")
    fair.turn()


def comes_out(fair: FairQueue, redis: Redis, work: Work) -> bool:
    """Whether work that is queued now is handed out in the end."""
    fair.enqueue(Waiting(work, "three", {"owner": "three"}))
    for _ in range(20):
        fair.turn()
        if redis.lpop("rq:queue:regnf") == work.name.encode():
            return True
    return False


@pytest.mark.parametrize("kind", ["string", "list", "hash", "set", "zset"])
def test_keys_of_another_type(redis: Redis, kind: str) -> None:
    used(redis)
    keys = [key for key in redis.keys(f"{PREFIX}*") + redis.keys("rq:queue:regnf*") if redis.type(key) != kind.encode()]
    assert keys
    for key in keys:
        redis.flushall()
        fair = used(redis)
        redis.delete(key)
        if kind == "string":
            redis.set(key, "x")
        elif kind == "list":
            redis.rpush(key, "x")
        elif kind == "hash":
            redis.hset(key, "x", "y")
        elif kind == "set":
            redis.sadd(key, "x")
        else:
            redis.zadd(key, {"x": 1.0})
        go_through(fair, redis)
        assert comes_out(fair, redis, OTHER), key


@pytest.mark.parametrize("value", ODD)
def test_values_that_are_no_numbers_or_names(redis: Redis, value: bytes) -> None:
    used(redis)
    members = [
        (key, member) for key in redis.keys(f"{PREFIX}*") if redis.type(key) == b"hash" for member in redis.hkeys(key)
    ]
    assert len(members) > 10
    for key, member in members:
        redis.flushall()
        fair = used(redis)
        redis.hset(key, member, value)
        go_through(fair, redis)
        assert comes_out(fair, redis, OTHER), (key, member)


@pytest.mark.parametrize(
    "said",
    [
        "OOM command not allowed when used memory > 'maxmemory'. script: 12ab, on @user_script:31.",
        "Error running script (call to f_12ab): @user_script:31: @user_script: 31: -OOM command not allowed",
        "MISCONF Redis is configured to save RDB snapshots, but cannot. script: 12ab, on @user_script:9.",
        "BUSY Redis is busy running a script.",
    ],
)
def test_a_redis_that_refuses_for_a_while_does_not_empty_the_queue(
    redis: Redis, monkeypatch: pytest.MonkeyPatch, said: str
) -> None:
    fair = used(redis)
    held = sorted(redis.keys("*"))

    def refuse(**_: object) -> int:
        raise ResponseError(said)

    monkeypatch.setattr(fair, "_script", refuse)
    with pytest.raises(ResponseError, match=re.escape(said)):
        fair.turn()
    assert sorted(redis.keys("*")) == held


@pytest.mark.parametrize("value", [None, "x", "1.5"])
def test_damaged_counters_begin_anew(redis: Redis, value: str | None) -> None:
    if value is None:
        redis.set(COUNTERS_KEY, "x")
    else:
        redis.hset(COUNTERS_KEY, "refused|a", value)
    count(redis, "refused", "a")
    assert list(Counters(redis).counts("refused")) == [(("a",), 1.0)]
