"""The transport to the workers over RQ: ids only, results and failures kept nowhere but in the records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from redis import Redis
from rq.command import send_command
from rq.worker_registration import WORKERS_BY_QUEUE_KEY

from regnf_state.ownership import ANONYMOUS, owner_of
from regnf_state.queue import QUEUE_NAME, Work
from regnf_state.records import JobRecord
from regnf_state.redis import payload
from regnf_state.redis.documents import shown
from regnf_state.redis.fair_queue import FairQueue, Line, Waiting


class RqJobQueue:
    """A JobQueue over RQ's lists and the fair queue before them, which has ``weights`` and ``reserve_s``. ``key`` signs
    what is put into Redis.
    """

    def __init__(
        self,
        redis: Redis,
        key: str | None = None,
        weights: Mapping[str, float] | None = None,
        reserve_s: float = 0.0,
    ) -> None:
        self._redis = redis
        self._key = key
        self.fair = FairQueue(redis, weights, reserve_s)

    def enqueue_registration(self, job_id: str, attempt: int, owner: str = ANONYMOUS, of_batch: bool = False) -> None:
        self._enqueue([(Work("registration", job_id, attempt), owner, of_batch)])

    def enqueue_jobs(self, jobs: Sequence[JobRecord]) -> None:
        self._enqueue([(Work("registration", job.id, job.attempt), job.owner, job.is_of_batch) for job in jobs])

    def enqueue_import(self, sha256: str, attempt: int = 1) -> None:
        self._enqueue([(Work("import", sha256, attempt), owner_of(sha256), False)])

    def _enqueue(self, waiting: Sequence[tuple[Work, str, bool]]) -> None:
        self.fair.enqueue_each(
            Waiting(work, owner, payload.written(work, self._redis, self._key), of_batch)
            for work, owner, of_batch in waiting
        )

    def holds_registration(self, job_id: str, attempt: int) -> bool:
        return self.fair.holds(Work("registration", job_id, attempt).name)

    def holds_import(self, sha256: str, attempt: int) -> bool:
        return self.fair.holds(Work("import", sha256, attempt).name)

    def stop(self, job_id: str, attempt: int) -> None:
        name = Work("registration", job_id, attempt).name
        if self.fair.remove(name):
            return
        worker: Any = self._redis.hget(f"rq:job:{name}", "worker_name")
        if worker:
            send_command(self._redis, shown(worker), "stop-job", job_id=name)

    def drop_import(self, sha256: str, attempt: int) -> None:
        self.fair.remove(Work("import", sha256, attempt).name)

    def turn(self) -> None:
        self.fair.turn()

    def awaited(self) -> list[str]:
        return self.fair.awaited()

    def release(self, reference: str) -> None:
        self.fair.release(reference)

    def position(self, work: Work) -> int | None:
        return self.fair.position(work)

    def spent(self, owner: str) -> dict[int, float]:
        return self.fair.spent(owner)

    def lines(self) -> list[Line]:
        """Every caller with work that waits."""
        return self.fair.lines()

    def live_workers(self) -> int:
        names = [shown(name) for name in self._redis.smembers(WORKERS_BY_QUEUE_KEY % QUEUE_NAME)]
        with self._redis.pipeline(transaction=False) as pipeline:
            for name in names:
                pipeline.exists(name)
                pipeline.hexists(name, "death")
            answers = pipeline.execute()
        return sum(bool(held) and not dead for held, dead in zip(answers[::2], answers[1::2], strict=True))
