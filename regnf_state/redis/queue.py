"""The transport to the workers over RQ: ids only, results and failures kept nowhere but in the records."""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Mapping, Sequence
from typing import Any

from redis import Redis
from rq.command import send_command
from rq.job import Job, JobStatus
from rq.serializers import JSONSerializer
from rq.worker_registration import WORKERS_BY_QUEUE_KEY

from regnf_state.ownership import ANONYMOUS, owner_of
from regnf_state.queue import QUEUE_NAME, Work
from regnf_state.records import JobRecord
from regnf_state.redis.documents import shown
from regnf_state.redis.fair_queue import FairQueue, Waiting

# What Redis holds of a piece of work in RQ's shape, a hash: written here, and believed only if written here.
#
# RQ itself would import whatever function a hash names, and the callbacks in it, and hand it on to jobs that depend
# on it. A worker therefore never lets RQ read one. It takes a name from RQ's list, checks here that the hash says
# exactly what ``written`` writes for this name, and makes the job again from the name. With a key, the hash must be
# signed too.

SIGNATURE = "regnf_signature"
_MAX_S = 24 * 3600
"""What RQ itself would allow a job; workers set the limit that counts from their own settings."""
_FAILURE_KEPT_S = 60
_WRITTEN_BY_RQ = frozenset(
    ("created_at", "enqueued_at", "started_at", "ended_at", "last_heartbeat", "worker_name", "status", "exc_info")
)
"""What RQ notes down of a job on its way. Nothing of it is used."""


def made(work: Work, redis: Redis) -> Job:
    """RQ's job for a piece of work."""
    return Job.create(
        work.function,
        args=[work.argument],
        connection=redis,
        id=work.name,
        origin=work.queue_name,
        timeout=_MAX_S,
        result_ttl=0,
        failure_ttl=_FAILURE_KEPT_S,
        status=JobStatus.QUEUED,
        serializer=JSONSerializer,
        description=f"{work.function} {work.name}",
    )


def signature(work: Work, key: str) -> str:
    """HMAC-SHA256 over the function and the name, which holds the argument and the attempt."""
    return hmac.new(key.encode(), f"regnf-queue-1\n{work.function}\n{work.name}".encode(), hashlib.sha256).hexdigest()


def written(work: Work, redis: Redis) -> dict[str, Any]:
    """The hash of a piece of work that waits, not signed. RQ reads data that is not compressed as well: the bytes of
    what is compressed depend on the release of zlib."""
    job = made(work, redis)
    return job.to_dict() | {"data": job.data}


def _believed(held: Mapping[bytes, bytes]) -> dict[str, bytes]:
    fields = {shown(field): value for field, value in held.items() if value}
    return {field: value for field, value in fields.items() if field not in _WRITTEN_BY_RQ}


class JobQueue(FairQueue):
    """Hands ids to workers, each at most once per attempt: enqueueing what is known already changes nothing.

    ``key`` signs what is put into Redis.
    """

    def __init__(self, redis: Redis, key: str | None = None) -> None:
        super().__init__(redis)
        self._key = key

    def enqueue_registration(self, job_id: str, attempt: int, owner: str = ANONYMOUS, of_batch: bool = False) -> None:
        """of_batch: it waits behind all that its owner has posted by itself, so that a batch holds nothing up."""
        self.enqueue(self._waiting(Work("registration", job_id, attempt), owner, of_batch))

    def enqueue_jobs(self, jobs: Sequence[JobRecord]) -> None:
        """The same for several accepted jobs, in one round trip, in their order."""
        self.enqueue(
            *(self._waiting(Work("registration", job.id, job.attempt), job.owner, job.is_of_batch) for job in jobs)
        )

    def enqueue_import(self, sha256: str, attempt: int = 1) -> None:
        """Its owner is named in the field's reference."""
        self.enqueue(self._waiting(Work("import", sha256, attempt), owner_of(sha256)))

    def _waiting(self, work: Work, owner: str, of_batch: bool = False) -> Waiting:
        signed = {SIGNATURE: signature(work, self._key)} if self._key is not None else {}
        return Waiting(work, owner, written(work, self._redis) | signed, of_batch)

    def read(self, queue_name: str, name: str, held: Mapping[bytes, bytes]) -> Work:
        """The work that a name and its hash mean. Raises ValueError unless the hash is one that this queue writes;
        its message repeats nothing of the hash."""
        work = Work.named(queue_name, name)
        believed = _believed(held)
        signed = believed.pop(SIGNATURE, b"")
        encode: Any = self._redis.get_encoder().encode
        if believed != _believed({encode(field): encode(value) for field, value in written(work, self._redis).items()}):
            raise ValueError("not what this service writes")
        if self._key is not None and not hmac.compare_digest(signed, signature(work, self._key).encode()):
            raise ValueError("not signed with the key of this service")
        return work

    def holds_registration(self, job_id: str, attempt: int) -> bool:
        """Whether the transport still knows of this attempt, waiting or running."""
        return self.holds(Work("registration", job_id, attempt).name)

    def holds_import(self, sha256: str, attempt: int) -> bool:
        return self.holds(Work("import", sha256, attempt).name)

    def stop(self, job_id: str, attempt: int) -> None:
        """Take a waiting job out of the queue, or tell the worker to end a running one."""
        name = Work("registration", job_id, attempt).name
        if self.remove(name):
            return
        worker: Any = self._redis.hget(f"rq:job:{name}", "worker_name")
        if worker:
            send_command(self._redis, shown(worker), "stop-job", job_id=name)

    def drop_import(self, sha256: str, attempt: int) -> None:
        """Take a waiting import out of the queue: its field is gone. One that runs goes on, and finds that itself."""
        self.remove(Work("import", sha256, attempt).name)

    def live_hosts(self) -> list[str]:
        """The hosts of the workers that have reported lately and have not signed off, one each."""
        with self._redis.pipeline(transaction=False) as pipeline:
            for name in self._redis.smembers(WORKERS_BY_QUEUE_KEY % QUEUE_NAME):
                pipeline.hmget(shown(name), "hostname", "death")
            return [shown(host) for host, death in pipeline.execute() if host is not None and death is None]

    def live_workers(self) -> int:
        """How many workers have reported lately."""
        return len(self.live_hosts())
