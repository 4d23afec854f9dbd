"""How a worker takes work, and how it waits for a Redis that is full, away or read-only."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from redis import Redis
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import OutOfMemoryError, ReadOnlyError, RedisError
from redis.exceptions import TimeoutError as RedisTimeoutError

from regnf_state.queue import Work
from regnf_state.records import FieldRecord, UnreadableRecordError
from regnf_state.redis.counters import count
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.queue import ForeignWorkError, JobQueue, Taken
from regnf_state.transitions import fields_of

_FIRST_WAIT_S = 0.1
MAX_WAIT_S = 2.0
_PASSING = (RedisConnectionError, RedisTimeoutError, OutOfMemoryError, ReadOnlyError)
_PASSING_WORDS = ("MISCONF ", "OOM ")
"""No class of their own: a disk that Redis cannot write to, and what older servers say of a script without memory."""
_SHOWN = 120
_Value = TypeVar("_Value")
logger = logging.getLogger(__name__)


class StopRequestedError(Exception):
    """The worker was told to stop while it waited for Redis."""


def passes(error: RedisError) -> bool:
    """Whether the same command may succeed later. Waiting does not help with any other error."""
    return isinstance(error, _PASSING) or any(word in str(error) for word in _PASSING_WORDS)


def retry_until_available(what: str, do: Callable[[], _Value], stopped: Callable[[], bool] = lambda: False) -> _Value:
    """What ``do`` returns once Redis accepts it, however long that takes; ``do`` may be called several times.

    Raises StopRequestedError when ``stopped`` by then, and any error that does not pass.
    """
    wait_s = _FIRST_WAIT_S
    refusals = 0
    while True:
        try:
            value = do()
        except RedisError as error:
            if not passes(error):
                raise
            if stopped():
                raise StopRequestedError from error
            if not refusals:
                logger.warning("%s: Redis refuses, trying until it does not: %s", what, error)
            refusals += 1
            time.sleep(wait_s)
            wait_s = min(2 * wait_s, MAX_WAIT_S)
        else:
            if refusals:
                logger.warning("%s: done after %d refusals", what, refusals)
            return value


class Taking:
    """Takes work for one worker. Everything may raise RedisError, and may be called again after that.

    What this service has not queued is removed, logged and counted, and never run. A registration whose fields are
    still being imported is parked.
    """

    def __init__(self, redis: Redis, queue: JobQueue) -> None:
        self._redis = redis
        self._queue = queue
        self.records = RecordStore(redis)  # without the journal: its storage does not survive the worker's forks

    def accept(self, taken: Taken) -> Work | None:
        """The work that a name means; None when it is not to be run now."""
        self._queue.turn()  # the next in turn is for the next worker
        try:
            work = self._queue.work_of(taken)
        except ForeignWorkError as error:
            self._queue.end(taken.name)
            count(self._redis, "queue_payloads_refused", taken.kind)
            logger.error("%s: %a is not run and removed: %s", taken.kind, taken.name[:_SHOWN], error)
            return None
        try:
            return None if work is None or (work.kind == "registration" and self._is_parked(work)) else work
        except UnreadableRecordError as error:
            logger.error("%s: %s", taken.name, error)
            return work  # whose process says so

    def _is_parked(self, work: Work) -> bool:
        job = self.records.get_job(work.argument)
        if job is None or job.attempt != work.attempt or job.status != "accepted":
            return False
        found = zip(fields_of(job), self.records.get_fields(fields_of(job)), strict=True)
        reference = next((name for name, field in found if _is_validating(field)), None)
        if reference is None:
            return False
        self._queue.park(work, job.owner, reference)
        if not _is_validating(self.records.get_field(reference)):
            self._queue.release(reference)  # its import ended between the two looks
        return True


def _is_validating(field: FieldRecord | None) -> bool:
    return field is not None and field.state == "validating"
