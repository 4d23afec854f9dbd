"""How a worker takes work: from the lists that the fair queue fills, and only work that the service itself has queued.

What is in Redis under a name is checked and then put aside: the job is made anew from its name. Anything else is
removed, logged and counted, and never run. A registration whose fields are still being imported is parked.
"""

from __future__ import annotations

import logging
from typing import Any, NamedTuple

from redis import Redis
from redis.exceptions import ResponseError

from regnf_state.queue import IMPORT_QUEUE_NAME, QUEUE_NAME, Work
from regnf_state.records import FieldRecord, JobRecord, UnreadableRecordError
from regnf_state.redis import payload
from regnf_state.redis.counters import count
from regnf_state.redis.documents import text
from regnf_state.redis.fair_queue import FairQueue
from regnf_state.redis.jobs import RedisRecordStore
from regnf_state.transitions import fields_of

LISTS = {f"rq:queue:{name}": name for name in (IMPORT_QUEUE_NAME, QUEUE_NAME)}
_SHOWN = 120
logger = logging.getLogger(__name__)


class Taken(NamedTuple):
    """A name that has left RQ's list of a queue."""

    queue_name: str
    name: str
    key: bytes
    """Of the hash that lies under this name."""


class Taking:
    """Takes work for one worker. Everything may raise RedisError, and may be called again after that."""

    def __init__(self, redis: Redis, fair: FairQueue, key: str | None) -> None:
        self._redis = redis
        self._fair = fair
        self._key = key
        self._records = RedisRecordStore(redis)  # without the journal: its storage does not survive the worker's forks

    def pop(self, timeout: int | None) -> Taken | None:
        """The next name, waited for so many seconds (None: not at all); None when there is none."""
        self._fair.turn()
        found: Any
        if timeout is not None:
            found = self._redis.blpop(list(LISTS), timeout)
        else:
            found = next(((key, name) for key in LISTS if (name := self._redis.lpop(key)) is not None), None)
        if found is None:
            return None
        key, name = found
        return Taken(LISTS[text(key)], name.decode(errors="backslashreplace"), b"rq:job:" + name)

    def accept(self, taken: Taken) -> Work | None:
        """The work that a name means; None when it is not to be run now."""
        self._fair.turn()  # the next in turn is for the next worker
        try:
            held: Any = self._redis.hgetall(taken.key)
        except ResponseError as error:
            if not str(error).startswith("WRONGTYPE"):
                raise
            self._refuse(taken, "not a hash")
            return None
        if not held:
            self._fair.finish(taken.name, 0.0)
            return None  # it was stopped meanwhile
        try:
            work = payload.read(taken.queue_name, taken.name, held, self._redis, self._key)
        except payload.PayloadError as error:
            self._refuse(taken, str(error))
            return None
        return None if work.kind == "registration" and self._is_put_aside(work) else work

    def _is_put_aside(self, work: Work) -> bool:
        """Whether the registration waits for an import. One with a record that cannot be read is run, which says so."""
        try:
            return self._parked(work)
        except UnreadableRecordError as error:
            logger.error("%s: %s", work.name, error)
            return False

    def _refuse(self, taken: Taken, why: str) -> None:
        self._fair.remove(taken.name)
        self._redis.delete(taken.key)
        count(self._redis, "queue_payloads_refused", taken.queue_name)
        logger.error("%s: %a is not run and removed: %s", taken.queue_name, taken.name[:_SHOWN], why)

    def _parked(self, work: Work) -> bool:
        """Whether the registration waits for an import, and has been put aside for that."""
        job = self._job(work)
        if job is None or job.attempt != work.attempt or job.status != "accepted":
            return False
        reference = self._awaited(job)
        if reference is None:
            return False
        self._fair.park(work, job.owner, reference)
        if not self._is_validating(self._records.get_field(reference)):
            self._fair.release(reference)  # its import ended between the two looks
        return True

    def _job(self, work: Work) -> JobRecord | None:
        return self._records.get_job(work.argument)

    def _awaited(self, job: JobRecord) -> str | None:
        names = fields_of(job)
        found = self._records.get_fields(names)
        return next((name for name, field in zip(names, found, strict=True) if self._is_validating(field)), None)

    @staticmethod
    def _is_validating(field: FieldRecord | None) -> bool:
        return field is not None and field.state == "validating"
