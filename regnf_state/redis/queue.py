"""The transport to the workers over RQ: ids only, as JSON, results and failures kept nowhere but in the records."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from redis import Redis
from rq import Queue
from rq.command import send_command
from rq.exceptions import DuplicateJobError, NoSuchJobError
from rq.executions import Execution, ExecutionRegistry
from rq.job import Job
from rq.serializers import JSONSerializer
from rq.worker_registration import WORKERS_BY_QUEUE_KEY

from regnf_state.queue import IMPORT_FUNCTION, IMPORT_QUEUE_NAME, QUEUE_NAME, REGISTER_FUNCTION
from regnf_state.redis.documents import text

_MAX_S = 24 * 3600
"""What RQ itself would allow a job; workers set the limit that counts from their own settings."""
_FAILURE_KEPT_S = 60


def registration_id(job_id: str, attempt: int) -> str:
    """RQ's name for one attempt at a job."""
    return f"{job_id}-{attempt}"


def import_id(sha256: str, attempt: int) -> str:
    """RQ's name for one attempt at an import."""
    return f"import-{sha256}-{attempt}"


def attempt_of(rq_id: str) -> int:
    """The attempt that an RQ job id names."""
    return int(rq_id.rpartition("-")[2])


class RqJobQueue:
    """A JobQueue over two RQ queues."""

    def __init__(
        self, redis: Redis, register_function: str = REGISTER_FUNCTION, import_function: str = IMPORT_FUNCTION
    ) -> None:
        self._redis = redis
        self._registrations = Queue(QUEUE_NAME, connection=redis, serializer=JSONSerializer)
        self._imports = Queue(IMPORT_QUEUE_NAME, connection=redis, serializer=JSONSerializer)
        self._register_function = register_function
        self._import_function = import_function

    def enqueue_registration(self, job_id: str, attempt: int) -> None:
        self._enqueue(self._registrations, self._register_function, job_id, registration_id(job_id, attempt))

    def enqueue_import(self, sha256: str, attempt: int = 1) -> None:
        self._enqueue(self._imports, self._import_function, sha256, import_id(sha256, attempt))

    def _enqueue(self, queue: Any, function: str, argument: str, rq_id: str) -> None:
        for _ in range(2):
            try:
                queue.enqueue(
                    function,
                    argument,
                    job_id=rq_id,
                    unique=True,
                    job_timeout=_MAX_S,
                    result_ttl=0,
                    failure_ttl=_FAILURE_KEPT_S,
                    description=f"{function} {rq_id}",
                )
            except DuplicateJobError:
                if self._holds(queue, rq_id):
                    return
                self._forget(queue, rq_id)  # RQ knows the id but lost the job between two of its lists
            else:
                return

    def _holds(self, queue: Any, rq_id: str) -> bool:
        """Whether the id waits in the list, or is being worked on by a worker that still reports.

        That it reports is told by what Redis lets expire, not by RQ's list of what has begun: the times in there are
        of the workers' clocks, and may be an hour off.
        """
        if self._redis.lpos(queue.key, rq_id) is not None:
            return True
        begun: Any = self._redis.zrange(ExecutionRegistry(rq_id, connection=self._redis).key, 0, -1)
        return any(self._redis.exists(Execution(text(one), rq_id, connection=self._redis).key) for one in begun)

    def holds_registration(self, job_id: str, attempt: int) -> bool:
        return self._holds(self._registrations, registration_id(job_id, attempt))

    def holds_import(self, sha256: str, attempt: int) -> bool:
        return self._holds(self._imports, import_id(sha256, attempt))

    def _forget(self, queue: Any, rq_id: str) -> None:
        with suppress(NoSuchJobError):
            Job.fetch(rq_id, connection=self._redis, serializer=JSONSerializer).delete()
        queue.remove(rq_id)

    def stop(self, job_id: str, attempt: int) -> None:
        rq_id = registration_id(job_id, attempt)
        if self._redis.lrem(self._registrations.key, 0, rq_id):
            self._forget(self._registrations, rq_id)
            return
        with suppress(NoSuchJobError):
            job = Job.fetch(rq_id, connection=self._redis, serializer=JSONSerializer)
            if job.worker_name:
                send_command(self._redis, job.worker_name, "stop-job", job_id=rq_id)

    def live_workers(self) -> int:
        names = [text(name) for name in self._redis.smembers(WORKERS_BY_QUEUE_KEY % QUEUE_NAME)]
        with self._redis.pipeline(transaction=False) as pipeline:
            for name in names:
                pipeline.exists(name)
                pipeline.hexists(name, "death")
            answers = pipeline.execute()
        return sum(bool(held) and not dead for held, dead in zip(answers[::2], answers[1::2], strict=True))
