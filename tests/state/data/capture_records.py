"""Writes what a release keeps in Redis and in the storage to a file: records of every kind, for tests of later ones.

    PYTHONPATH=CHECKOUT python tests/state/data/capture_records.py OUTPUT

Run it with the checkout of that release first on the path. records_fb7e8d8.json is of commit fb7e8d8.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from redis import Redis

from regnf_state.blobs.local import LocalBlobStore
from regnf_state.journal.journaled_records import JournaledRecordStore, Rebuilder
from regnf_state.manifest import Artifact, Manifest, manifest_key
from regnf_state.records import FieldRecord, JobRecord
from regnf_state.redis.client import connect
from regnf_state.redis.queue import JobQueue
from tests.redis_server import private_redis

FIELDS = {name: (digit * 64, digit * 64 + "_lab")[name == "of_lab"] for name, digit in
          {"ready": "a", "validating": "b", "rejected": "c", "of_lab": "d"}.items()}  # fmt: skip
ERROR = {"type": "/docs#NO_SURFACE_IN_OBJECT", "title": "No surface", "status": 422, "reason": "NO_SURFACE_IN_OBJECT",
         "detail": "none", "hint": "look at the picture"}  # fmt: skip


def job(records: JournaledRecordStore, name: str, **request: Any) -> JobRecord:
    asked = {"scene": FIELDS["ready"], "object": FIELDS["ready"], "candidates": None, "seed": 0, "version": 1} | request
    now = records.now()
    made = JobRecord(name, "registration", "accepted", asked, {"scene": "a" * 64, "seed": 0}, now, now)
    return records.create_job(made, 100)[0]


def fill(records: JournaledRecordStore, blobs: LocalBlobStore) -> None:
    for name, reference in FIELDS.items():
        now = records.now()
        said = {"label": name, "description": {"family": "tiny"}}
        records.create_field(FieldRecord(reference, "validating", 5, now, now, **said))
        blobs.put(f"fields/{reference}/original", b"bytes")
    for name in ("ready", "of_lab"):
        blobs.put(f"fields/{FIELDS[name]}/field.safetensors", b"bytes")
        records.update_field(FIELDS[name], state="ready", report={"family": "tiny", "bounds": [[0, 0, 0], [1, 1, 1]]})
    records.update_field(FIELDS["rejected"], state="rejected", error=ERROR)
    job(records, "accepted", webhook={"url": "https://hooks.example/1"})
    job(records, "of-lab", scene=FIELDS["of_lab"], object=None, candidates=[FIELDS["of_lab"]])
    for name in ("running", "successful", "failed", "requeued"):
        job(records, name, webhook={"url": "https://hooks.example/2"})
        records.update_job(name, 1, status="running", phase="loading", worker="w")
        records.update_job(name, 1, phase="sampling", progress=0.25, engine={"version": "0.1.0"})
    blobs.put("jobs/successful/1/result.json", b'{"verdict": "registered"}')
    blobs.put(manifest_key("successful"), Manifest("successful", 1, (Artifact("result.json", 25, "0" * 64),)).to_json())
    records.update_job("successful", 1, status="successful", verdict="registered")
    records.update_job("failed", 1, status="failed", error=ERROR)
    records.requeue_job("requeued", 1)
    job(records, "dismissed")
    records.request_cancel("dismissed")
    records.set_if_absent("idempotency:key", "digest 1.5", 24 * 3600)


def value_of(redis: Redis, key: str) -> Any:
    match redis.type(key):
        case "hash":
            return redis.hgetall(key)
        case "set":
            return sorted(redis.smembers(key))
        case "zset":
            return redis.zrange(key, 0, -1, withscores=True)
        case "stream":
            return redis.xrange(key)
    return redis.get(key)


def main(output: Path) -> None:
    with private_redis() as url, connect(url) as redis, TemporaryDirectory() as folder:
        blobs = LocalBlobStore(Path(folder))
        records = JournaledRecordStore(redis, 7 * 24 * 3600, blobs)
        Rebuilder(records, JobQueue(redis), blobs).run_if_needed()
        fill(records, blobs)
        text = Redis.from_url(url, decode_responses=True)
        keys = {key: [text.type(key), value_of(text, key)] for key in sorted(text.scan_iter())}
        storage = {key: blobs.open(key).read().decode() for key in blobs.list("")}
    output.write_text(json.dumps({"redis": keys, "storage": storage}, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
