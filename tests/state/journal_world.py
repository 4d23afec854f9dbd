"""Records over a real Redis and a journal in a folder, and how Redis loses them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from redis import Redis

from regnf_state.journal.journaled_records import JournaledRecordStore, Rebuilder, Rebuilt
from regnf_state.records import FieldRecord, JobRecord
from tests.stores import HeldBlobs, WatchedQueue

SCENE, OBJECT = "a" * 64, "b" * 64
RETENTION_S = 3600


@dataclass
class World:
    """Records over a real Redis and a journal in a folder, as one of several machines would hold them."""

    redis: Redis
    blobs: HeldBlobs

    def __post_init__(self) -> None:
        self.queue = WatchedQueue(self.redis)
        self.records = JournaledRecordStore(self.redis, RETENTION_S, self.blobs)
        self.rebuilder = Rebuilder(self.records, self.queue, self.blobs)

    def accept(self, job_id: str = "j1", created: float | None = None, webhook: str | None = None) -> JobRecord:
        now = self.records.now() if created is None else created
        request = {"scene": SCENE, "object": OBJECT} | ({} if webhook is None else {"webhook": {"url": webhook}})
        job = JobRecord(job_id, "registration", "accepted", request, {}, now, now)
        return self.records.create_job(job, 100)[0]

    def run(self, job_id: str = "j1", attempt: int = 1) -> None:
        self.records.update_job(job_id, attempt, status="running", worker="w")

    def end(self, status: str, job_id: str = "j1", attempt: int = 1) -> JobRecord:
        error = {"reason": "NO_SURFACE_IN_OBJECT"} if status == "failed" else None
        return self.records.update_job(job_id, attempt, status=status, error=error)

    def field(self, state: str = "ready") -> FieldRecord:
        now = self.records.now()
        self.records.create_field(FieldRecord(SCENE, "validating", 5, now, now, label="a room"))
        self.blobs.put(f"fields/{SCENE}/original", b"bytes")
        if state == "ready":
            self.blobs.put(f"fields/{SCENE}/field.safetensors", b"bytes")
        if state != "validating":
            self.blobs.delete(f"fields/{SCENE}/original")
            self.records.update_field(SCENE, state=state, report={"family": "tiny"})
        return self.known_field()

    def known_field(self) -> FieldRecord:
        found = self.records.get_field(SCENE)
        assert found is not None
        return found

    def lose_redis(self) -> Rebuilt:
        self.redis.flushall()
        return self.rebuilder.run_if_needed()

    def job(self, job_id: str = "j1") -> JobRecord:
        found = self.records.get_job(job_id)
        assert found is not None
        return found


def fresh_world(redis: Redis, folder: Path) -> World:
    """A service that has just started, over an empty Redis."""
    redis.flushall()
    made = World(redis, HeldBlobs(folder))
    made.rebuilder.run_if_needed()
    return made
