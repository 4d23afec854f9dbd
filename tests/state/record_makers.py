"""Records of jobs and fields for tests of record stores."""

from __future__ import annotations

import json
from typing import Any

from redis import Redis

from regnf_state.records import FieldRecord, JobRecord
from regnf_state.redis.jobs import RecordStore

SCENE, OBJECT = "a" * 64, "b" * 64


def job(store: RecordStore, name: str = "j1", created: float | None = None) -> JobRecord:
    now = store.now()
    created = now if created is None else created
    request = {"scene": SCENE, "object": OBJECT}
    return JobRecord(name, "registration", "accepted", request, {"scene": SCENE}, created=created, updated=now)


def field(
    store: RecordStore, sha256: str = SCENE, created: float | None = None, label: str | None = None
) -> FieldRecord:
    now = store.now()
    return FieldRecord(sha256, "validating", 10, now if created is None else created, now, label=label)


def started(store: RecordStore, name: str = "j1") -> JobRecord:
    store.create_job(job(store, name), 10)
    return store.update_job(name, 1, status="running", phase="loading")


def finished(store: RecordStore, status: str, name: str = "j1") -> JobRecord:
    started(store, name)
    return store.update_job(name, 1, status=status, error={"reason": "WORKER_LOST"} if status == "failed" else None)


def change(redis: Redis, key: str, **members: Any) -> None:
    """Another release, or a fault, writes into a document."""
    document = json.loads(redis.hget(key, "document") or "{}")  # type: ignore[arg-type]
    redis.hset(key, "document", json.dumps(document | members))
