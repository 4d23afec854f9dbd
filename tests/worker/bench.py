"""A private Redis, a folder, and worker processes: what tests of the worker stand on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from redis import Redis

from regnf_state.blobs.local import LocalBlobStore
from regnf_state.ownership import ANONYMOUS, reference_of
from regnf_state.records import FINISHED, FieldRecord, JobRecord
from regnf_state.redis.client import connect
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.queue import JobQueue
from regnf_state.settings import Settings, variables
from regnf_worker.models import Context
from tests.listing import below
from tests.redis_server import private_redis
from tests.requests import request_record

SCENE, OBJECT = "a" * 64, "b" * 64
DEADLINE_S = 60.0
_Value = TypeVar("_Value")


def eventually(
    look: Callable[[], _Value], what: str | Callable[[], str] = "condition", deadline_s: float = DEADLINE_S
) -> _Value:
    """What ``look`` returns once that is truthy. Fails after the deadline, telling what was waited for."""
    end = time.monotonic() + deadline_s
    while not (value := look()):
        assert time.monotonic() < end, f"{what if isinstance(what, str) else what()}: not within {deadline_s} s"
        time.sleep(0.02)
    return value


@dataclass
class Bench:
    """Stores over a private Redis, and the workers started over them."""

    context: Context
    redis: Redis
    folder: Path
    environment: dict[str, str]
    given: dict[str, object]
    """The settings that are not the usual ones."""
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def start_worker(self, module: str = "tests.worker.tiny_worker", **settings: object) -> subprocess.Popen[bytes]:
        """A worker process; returns once it is listed as live."""
        before = self.context.queue.live_workers()
        worker = self.launch_worker(module, **settings)
        eventually(lambda: self.context.queue.live_workers() > before or worker.poll() is not None, "live worker")
        assert worker.poll() is None, self.log()
        return worker

    def launch_worker(self, module: str = "tests.worker.tiny_worker", **settings: object) -> subprocess.Popen[bytes]:
        """A worker process, however far it gets."""
        environment = self.environment | variables(**self.given | settings)
        with (self.folder / f"worker-{len(self.workers)}.log").open("wb") as log:
            worker = subprocess.Popen([sys.executable, "-m", module], env=environment, stderr=log)
        self.workers.append(worker)
        return worker

    def log(self) -> str:
        return "\n".join(path.read_text() for path in sorted(self.folder.glob("worker-*.log")))

    def add_ready_fields(self, owner: str = ANONYMOUS) -> None:
        for sha256 in (reference_of(owner, SCENE), reference_of(owner, OBJECT)):
            now = self.context.records.now()
            self.context.records.create_field(FieldRecord(sha256, "validating", 1, now, now))
            self.context.blobs.put(f"fields/{sha256}/field.safetensors", sha256[:1].encode())
            self.context.records.update_field(sha256, state="ready", views="none")

    def submit(self, do: str, job_id: str = "j1", owner: str = ANONYMOUS, **changes: object) -> JobRecord:
        """Record and queue a job whose engine shall do this."""
        now = self.context.records.now()
        object_ = None if "candidates" in changes else reference_of(owner, OBJECT)
        request = request_record(reference_of(owner, SCENE), object_, do, **changes)
        record, created = self.context.records.create_job(
            JobRecord(job_id, "registration", "accepted", request, {}, now, now), 100
        )
        assert created
        self.context.queue.enqueue_registration(job_id, record.attempt, owner)
        return record

    def job(self, job_id: str = "j1") -> JobRecord:
        record = self.context.records.get_job(job_id)
        assert record is not None
        return record

    def finished(self, job_id: str = "j1") -> JobRecord:
        return eventually(lambda: record if (record := self.job(job_id)).status in FINISHED else None, self.log)

    def reaches(self, phase: str, job_id: str = "j1") -> JobRecord:
        return eventually(lambda: record if (record := self.job(job_id)).phase == phase else None, phase)

    def leftovers(self) -> list[str]:
        """Temporary files of jobs and of the blob store."""
        scratch = self.context.settings.scratch_dir
        inside = [path for folder in scratch.iterdir() for path in below(folder) if path.parent == folder]
        temporary = (self.context.settings.blob_dir / ".tmp").iterdir()
        return [path.name for path in [*inside, *temporary] if path.name != ".lock"]


@contextmanager
def bench(folder: Path, **settings: object) -> Iterator[Bench]:
    """A bench below ``folder``; every worker is gone when it closes."""
    with ExitStack() as stack:
        url = str(settings.get("redis_url") or stack.enter_context(private_redis()))
        redis = stack.enter_context(connect(url))
        environment = {name: value for name, value in os.environ.items() if not name.startswith("REGNF_")}
        given = {"redis_url": url, "state_dir": folder / "state", "heartbeat_s": 0.2} | settings
        values = Settings(**given)  # type: ignore[arg-type]
        stores = (RecordStore(redis), LocalBlobStore(values.blob_dir), JobQueue(redis))
        made = Bench(Context(values, *stores), redis, folder, environment, given)
        try:
            yield made
        finally:
            for worker in made.workers:
                worker.kill()
                worker.wait()


def kill(pid: int, number: signal.Signals = signal.SIGKILL) -> None:
    os.kill(pid, number)
