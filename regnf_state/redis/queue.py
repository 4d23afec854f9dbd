"""The transport to the workers over RQ: ids only, results and failures kept nowhere but in the records."""

from __future__ import annotations

import hashlib
import hmac
import json
import zlib
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
# exactly what ``written`` writes for this name, and makes the job anew from the name. With a key, the hash must be
# signed too.

SIGNATURE = "regnf_signature"
MAX_S = 24 * 3600
"""What RQ itself would allow a job; workers set the limit that counts from their own settings."""
_FAILURE_KEPT_S = 60
_MAX_DATA_BYTES = 4096
_WRITTEN_BY_RQ = frozenset(
    {"created_at", "enqueued_at", "started_at", "ended_at", "last_heartbeat", "worker_name", "status", "exc_info"}
)
"""What RQ notes down of a job on its way. Nothing of it is used."""


class PayloadError(ValueError):
    """A hash that is not one of ours. Says what is wrong with it, and repeats nothing of it."""


def made(work: Work, redis: Redis) -> Job:
    """RQ's job for a piece of work."""
    return Job.create(
        work.function,
        args=[work.argument],
        connection=redis,
        id=work.name,
        origin=work.queue_name,
        timeout=MAX_S,
        result_ttl=0,
        failure_ttl=_FAILURE_KEPT_S,
        status=JobStatus.QUEUED,
        serializer=JSONSerializer,
        description=f"{work.function} {work.name}",
    )


def signature(work: Work, key: str) -> str:
    """HMAC-SHA256 over the function and the name, which holds the argument and the attempt."""
    return hmac.new(key.encode(), f"regnf-queue-1\n{work.function}\n{work.name}".encode(), hashlib.sha256).hexdigest()


def written(work: Work, redis: Redis, key: str | None) -> dict[str, Any]:
    """The hash of a piece of work that waits."""
    fields: dict[str, Any] = made(work, redis).to_dict()
    return fields | ({SIGNATURE: signature(work, key)} if key is not None else {})


def read(queue_name: str, name: str, held: Mapping[bytes, bytes], redis: Redis, key: str | None) -> Work:
    """The work that a name and its hash mean. Raises PayloadError unless the hash is as ``written`` makes it."""
    try:
        work = Work.named(queue_name, name)
    except ValueError as error:
        raise PayloadError(str(error)) from error
    fields = {field.decode(errors="replace"): value for field, value in held.items()}
    expected = {field: _bytes(value) for field, value in written(work, redis, None).items()}
    if _data(fields.pop("data", b"")) != [work.function, None, [work.argument], {}]:
        raise PayloadError("another function, or other arguments")
    signed = fields.pop(SIGNATURE, b"")
    if key is not None and not hmac.compare_digest(signed, signature(work, key).encode()):
        raise PayloadError("not signed with the key of this service")
    del expected["data"]
    for field in fields.keys() | expected.keys():
        if field not in _WRITTEN_BY_RQ and fields.get(field, b"") != expected.get(field, b""):
            raise PayloadError(f"another {field}" if field in expected else "a member that is not ours")
    return work


def _bytes(value: Any) -> bytes:
    return value if isinstance(value, bytes) else str(value).encode()


def _data(value: bytes) -> Any:
    """What the payload names, decompressed up to a limit; None for what is no JSON."""
    unpacker = zlib.decompressobj()
    try:
        plain = unpacker.decompress(value, _MAX_DATA_BYTES)
        return json.loads(plain) if unpacker.eof else None
    except (zlib.error, ValueError, RecursionError):
        return None


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
        return Waiting(work, owner, written(work, self._redis, self._key), of_batch)

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

    def live_workers(self) -> int:
        """How many workers have reported lately."""
        names = [shown(name) for name in self._redis.smembers(WORKERS_BY_QUEUE_KEY % QUEUE_NAME)]
        with self._redis.pipeline(transaction=False) as pipeline:
            for name in names:
                pipeline.exists(name)
                pipeline.hexists(name, "death")
            answers = pipeline.execute()
        return sum(bool(held) and not dead for held, dead in zip(answers[::2], answers[1::2], strict=True))
