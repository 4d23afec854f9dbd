"""Records of an earlier release, put back into Redis and a storage as they were."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from redis import Redis

from regnf_state.blobs.base import BlobStore

CAPTURED = json.loads((Path(__file__).parent / "data/records_fb7e8d8.json").read_text())


def put_back(redis: Redis, blobs: BlobStore) -> None:
    """Fill an emptied Redis and an empty storage."""
    redis.flushall()
    for key, (kind, value) in CAPTURED["redis"].items():
        _PUT[kind](redis, key, value)
    for key, value in CAPTURED["storage"].items():
        blobs.put(key, value.encode())


def _stream(redis: Redis, key: str, entries: list[Any]) -> None:
    for identifier, members in entries:
        redis.xadd(key, members, id=identifier)


_PUT: dict[str, Any] = {
    "hash": lambda redis, key, value: redis.hset(key, mapping=value),
    "set": lambda redis, key, value: redis.sadd(key, *value),
    "zset": lambda redis, key, value: redis.zadd(key, dict(value)),
    "stream": _stream,
    "string": lambda redis, key, value: redis.set(key, value),
}
