"""The real stores, over an emptied Redis and a folder, with what tests look at and move by hand."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from redis import Redis

from regnf_service.services import Services
from regnf_service.webhooks.service import webhooks_of
from regnf_state.blobs.local import LocalBlobStore
from regnf_state.journal.journaled_records import JournaledRecordStore, Rebuilder
from regnf_state.queue import IMPORT_QUEUE_NAME, QUEUE_NAME, Work
from regnf_state.redis.client import connect
from regnf_state.redis.documents import RedisDocuments, text
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.queue import JobQueue
from regnf_state.settings import Settings
from regnf_state.stores import Stores
from tests.redis_server import private_redis

JOURNAL = "journal/"


class HeldBlobs(LocalBlobStore):
    """A local store that shows what it holds."""

    @property
    def blobs(self) -> dict[str, bytes]:
        """Everything that is held, by key; not what the journal says of it."""
        held = {}
        for key in self.list(""):
            if not key.startswith(JOURNAL):
                with self.open(key) as file:
                    held[key] = file.read()
        return held

    def age(self) -> None:
        """Everything that is held was written long ago."""
        for key in self.list(""):
            os.utime(self.path_of(key), (0, 0))


class WatchedQueue(JobQueue):
    """A queue in Redis that shows what it holds, and what it was told to stop."""

    def __init__(self, redis: Redis, workers: int | None = None) -> None:
        super().__init__(redis)
        self.workers = workers
        self.stopped: list[tuple[str, int]] = []

    @property
    def registrations(self) -> list[tuple[str, int]]:
        """(job, attempt) of what waits, in order."""
        return [(work.argument, work.attempt) for work in self.waiting if work.kind == "registration"]

    @property
    def imports(self) -> list[tuple[str, int]]:
        """(field, attempt) of what waits, in order."""
        return [(work.argument, work.attempt) for work in self.waiting if work.kind == "import"]

    @property
    def waiting(self) -> list[Work]:
        """What waits, whether in RQ's list or in a line: each owner's in order, what is next first."""
        lists = [f"rq:queue:{IMPORT_QUEUE_NAME}", f"rq:queue:{QUEUE_NAME}"]
        lines = [f"regnf:queue:line:{line.owner}" for line in self.lines()]
        names = [text(name) for key in lists + lines for name in self._redis.lrange(key, 0, -1)]
        kinds = [IMPORT_QUEUE_NAME if name.startswith("import-") else QUEUE_NAME for name in names]
        return [Work.named(kind, name) for kind, name in zip(kinds, names, strict=True)]

    def lose(self) -> None:
        """Forget everything, as a queue that was never told."""
        for work in self.waiting:
            self.remove(work.name)

    def take(self, job_id: str, attempt: int) -> None:
        """What a worker does first with a registration: it leaves the queue."""
        self.remove(Work("registration", job_id, attempt).name)

    def stop(self, job_id: str, attempt: int) -> None:
        self.stopped.append((job_id, attempt))
        super().stop(job_id, attempt)

    def live_workers(self) -> int:
        return super().live_workers() if self.workers is None else self.workers


class ShiftedClock(RedisDocuments):
    """Records whose clock a test moves: it stands at ``frozen``, if set, and is ahead by ``ahead_s``.

    What Redis lets expire goes by its own clock.
    """

    frozen: float | None = None
    ahead_s = 0.0

    def now(self) -> float:
        return self._moved(super().now())

    def _read(self, kind: Any, name: str) -> tuple[Any, float]:
        record, now = super()._read(kind, name)
        return record, self._moved(now)

    def _moved(self, now: float) -> float:
        return (now if self.frozen is None else self.frozen) + self.ahead_s


class ShiftedRecords(ShiftedClock, RecordStore):
    """Records alone."""


class ShiftedJournaledRecords(ShiftedClock, JournaledRecordStore):
    """Records with their journal."""


@dataclass(frozen=True)
class TestStores(Stores):
    """The stores of one test."""

    __test__ = False
    records: ShiftedJournaledRecords
    blobs: HeldBlobs
    queue: WatchedQueue


def stores_over(redis: Redis, folder: Path, retention_s: int = 7 * 24 * 3600) -> TestStores:
    """Fresh stores, over a Redis that is emptied, as a service finds them that has just started."""
    redis.flushall()
    blobs = HeldBlobs(folder)
    records, queue = ShiftedJournaledRecords(redis, retention_s, blobs), WatchedQueue(redis, workers=1)
    Rebuilder(records, queue, blobs).run_if_needed()
    return TestStores(redis, records, blobs, queue)


def expire(redis: Redis, job_id: str) -> None:
    """Have a finished job outlive its retention now."""
    redis.delete(f"regnf:job:{job_id}", f"regnf:job:{job_id}:events")
    redis.zadd("regnf:jobs:expiring", {job_id: 1.0}, xx=True)


@contextmanager
def private_stores() -> Iterator[TestStores]:
    """Stores over a Redis and a folder of their own."""
    with private_redis() as url, connect(url) as redis, TemporaryDirectory() as folder:
        yield stores_over(redis, Path(folder))


def services_over(redis: Redis, settings: Settings) -> Services:
    """What the routes of a service are given."""
    stores = stores_over(redis, settings.blob_dir, settings.job_retention_s)
    return Services(settings, redis, stores.records, stores.blobs, stores.queue, webhooks_of(settings, redis))
