"""What a neighbor who can write to Redis may do: records and queue entries with random faults, put there by hand."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import httpx
from redis import Redis
from redis.exceptions import RedisError

from benchmarks.attacks.outcome import Outcome
from benchmarks.service_load.house import House, running_house
from benchmarks.service_load.small_fields import SmallPair, submit, write_small_pair
from regnf_client import Client
from regnf_state.redis.client import connect

_BATCH = 5
_LOOKS = ("/jobs?limit=100", "/fields?limit=100", "/readyz")
_KEPT = ("rq:worker", "rq:wip", "rq:clean", "regnf:storage")
_ALLOWED = (200, 304, 404, 409, 410, 503)


def attack_stored_state(folder: Path, inputs: int, seed: int) -> Outcome:
    """Change ``inputs`` things in Redis, a few at a time; each time the service has to answer and to work.

    After each batch Redis gets back what it held before, so that every batch meets a sound service.
    """
    outcome, trap = Outcome(), folder / "trap"
    settings: dict[str, object] = {"threads": 1, "heartbeat_s": 1.0, "lost_after_s": 5.0, "quota_calls_per_s": 0}
    with running_house(folder, workers=1, **settings) as house, connect(house.redis.url) as redis:
        pair = write_small_pair(folder)
        with Client(house.address) as service:
            request = pair.upload(service)
            job = submit(service, request)
            service.wait(job)
        sound = _held(redis)
        for first in range(0, inputs, _BATCH):
            httpx.post(f"{house.address}/register", json=request | {"seed": first + 1}, timeout=30)
            for number in range(first, min(first + _BATCH, inputs)):
                _change(Random(f"{seed} {number}"), redis, trap, outcome)
            _look(outcome, house, job, first)
            _put_back(redis, sound)
        if trap.exists():
            outcome.fault("a function that was put into the queue by hand has run")
        redis.flushall()
        _works(outcome, house, pair)
        outcome.peak_bytes = house.api_peak()
    return outcome


def _held(redis: Redis) -> dict[bytes, Any]:
    """What Redis keeps, as it dumps it; what belongs to the running worker aside."""
    return {key: redis.dump(key) for key in redis.scan_iter("*") if not key.decode().startswith(_KEPT)}


def _put_back(redis: Redis, sound: dict[bytes, Any]) -> None:
    for key in redis.scan_iter("*"):
        if not key.startswith(tuple(kept.encode() for kept in _KEPT)):
            redis.delete(key)
    for key, value in sound.items():
        redis.restore(key, 0, value, replace=True)


def _change(random: Random, redis: Redis, trap: Path, outcome: Outcome) -> None:
    outcome.inputs += 1
    kinds = [_change_document, _change_document, _change_type, _change_member, _change_value, _drop]
    try:
        if random.random() < 0.25:
            outcome.ends[_queue_entry(random, redis, trap)] += 1
        else:
            outcome.ends[random.choice(kinds)(random, redis)] += 1
    except RedisError as error:
        outcome.ends[f"refused by Redis: {type(error).__name__}"] += 1


def _keys(random: Random, redis: Redis, pattern: str) -> bytes | None:
    found: Any = sorted(key for key in redis.scan_iter(pattern, count=1000) if not key.decode().startswith(_KEPT))
    return random.choice(found) if found else None


def _change_document(random: Random, redis: Redis) -> str:
    """A record whose JSON document has another member, another value, or is no JSON."""
    key = _keys(random, redis, random.choice(["regnf:job:*", "regnf:field:*"]))
    if key is None or redis.type(key) != b"hash":
        return "no such record"
    held: Any = redis.hget(key, "document")
    try:
        document = json.loads(held or b"{}")
    except ValueError:
        document = {}
    if not isinstance(document, dict):
        document = {}
    name = random.choice([*document, "unknown"])
    values = [None, -1, "x", [], {}, 1e300, "9" * 3000, {"reason": 3}, True, "2" * 64]
    text = json.dumps(document | {name: random.choice(values)})
    redis.hset(key, "document", random.choice([text, text, text, text[:-2], "\xff", "[]", "null", ""]))
    return "document changed"


def _change_type(random: Random, redis: Redis) -> str:
    """A key of another type than the service expects."""
    key = _keys(random, redis, "regnf:*")
    if key is None:
        return "no such key"
    kinds: list[Callable[[bytes], Any]] = [
        lambda k: redis.set(k, "x"),
        lambda k: redis.rpush(k, "x"),
        lambda k: redis.hset(k, "x", "y"),
        lambda k: redis.sadd(k, "x"),
        lambda k: redis.zadd(k, {"x": 1.0}),
    ]
    redis.delete(key)
    random.choice(kinds)(key)
    return "type changed"


def _change_member(random: Random, redis: Redis) -> str:
    """An index with a member that names nothing."""
    key = _keys(random, redis, random.choice(["regnf:jobs:*", "regnf:fields:*", "regnf:owner:*"]))
    if key is None:
        return "no such index"
    member = random.choice(["x", "", "\x00", "0" * 32, "../x", "é" * 200, "-1"])
    score = random.choice([0.0, -1e300, 1e300, float("inf"), time.time()])
    if redis.type(key) == b"zset":
        redis.zadd(key, {member: score})
    elif redis.type(key) == b"set":
        redis.sadd(key, member)
    return "index changed"


def _change_value(random: Random, redis: Redis) -> str:
    """A value or name within what the fair queue, the counters and RQ keep, of the same type as before."""
    key = _keys(random, redis, random.choice(["regnf:queue:*", "regnf:queue:*", "regnf:[cr]*", "rq:*"]))
    if key is None:
        return "no such key"
    value = random.choice([b"x", b"", b"nan", b"inf", b"-inf", b"-1", b"0", b"\xff\xfe", b"9" * 400, b"x" * 100_000])
    members: Any
    match redis.type(key):
        case b"hash":
            members = sorted(redis.hkeys(key))
            redis.hset(key, random.choice([*members, b"\xff", b"x"]), value)
        case b"zset":
            redis.zadd(key, {value: random.choice([0.0, float("inf"), float("-inf"), 1e300])})
        case b"list":
            random.choice([redis.lpush, redis.rpush])(key, value)
        case b"set":
            redis.sadd(key, value)
        case b"string":
            redis.set(key, value)
    return "value changed"


def _drop(random: Random, redis: Redis) -> str:
    key = _keys(random, redis, "*")
    if key is not None:
        redis.delete(key)
    return "key dropped"


def _queue_entry(random: Random, redis: Redis, trap: Path) -> str:
    """A queue entry that asks a worker to run something else, or something odd."""
    functions = (
        "os.mkdir",
        "os.system",
        "builtins.exec",
        "regnf_worker.jobs.run_registration",
        "subprocess.run",
        "x",
        "",
    )
    function, rq_id = (
        random.choice(functions),
        random.choice(["a-1", "b", "", "x" * 300, f"{random.randrange(99)}-1", "é-1"]),
    )
    arguments = random.choice([[str(trap)], [f"touch {trap}"], [], [None], [{"a": 1}], ["0" * 32], ["\x00"]])
    data = random.choice(
        [
            json.dumps([function, None, arguments, {}]),
            json.dumps([function, "os", arguments, {"mode": 1}]),
            "{",
            "[]",
            "\x80\x04.",
            json.dumps({"a": 1}),
        ]
    )
    held: dict[str, Any] = {"data": data, "status": "queued", "origin": random.choice(["regnf", "x"]), "timeout": "60"}
    hooks = (
        "success_callback_name",
        "failure_callback_name",
        "stopped_callback_name",
        "meta",
        "dependency_ids",
        "created_at",
    )
    for name in random.sample(hooks, random.randrange(3)):
        held[name] = random.choice(["os.mkdir", "x", "{", "\xff", json.dumps({"a": 1})])
    redis.delete(f"rq:job:{rq_id}")
    redis.hset(f"rq:job:{rq_id}", mapping=held)
    queue = random.choice(["regnf", "regnf-import"])
    random.choice([redis.rpush, redis.lpush])(f"rq:queue:{queue}", rq_id)
    redis.sadd("rq:queues", f"rq:queue:{queue}")
    return "queue entry"


def _look(outcome: Outcome, house: House, job: str, number: int) -> None:
    """Every list and the job answer; API and worker live."""
    paths = (*_LOOKS, f"/jobs/{job}", f"/jobs/{job}/result", f"/jobs/{job}/events")
    begun = time.monotonic()
    for path in paths:
        try:
            with httpx.stream("GET", house.address + path, timeout=20) as answer:
                status = answer.status_code
        except httpx.HTTPError as error:
            outcome.fault(f"{path} after change {number}: {error!r}")
            continue
        outcome.ends[f"GET {path.split('?')[0].replace(job, '{id}')} {status}"] += 1
        if status not in _ALLOWED:
            outcome.fault(f"{path} after change {number}: {status}")
    outcome.slowest_s = max(outcome.slowest_s, time.monotonic() - begun)
    house.api_memory()
    if house.workers[0].poll() is not None:
        outcome.fault(f"the worker ended after change {number}: {house.log()[-1500:]}")
        house.kill_worker(0)


def _works(outcome: Outcome, house: House, pair: SmallPair) -> None:
    """With an empty Redis and the storage as it is, an upload and a registration come to their end."""
    try:
        with Client(house.address) as service:
            job = submit(service, {**pair.upload(service), "seed": 999_999})
            service.wait(job)
            outcome.ends[f"a registration afterwards: {service.result(job).verdict}"] += 1
    except Exception as error:  # noqa: BLE001 -- whatever it is, it is a fault of the service
        outcome.fault(f"a registration afterwards: {error!r}"[:500])
