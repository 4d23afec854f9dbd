"""RQ's worker, made to survive a Redis that refuses commands, and to run only work that the service itself has queued.

There are three kinds of calls of Redis. What must succeed before the worker continues, such as its sign of life, is
repeated until Redis accepts it: a worker that cannot write takes nothing. What only keeps RQ's own entries tidy is
skipped: job records are the truth, and RQ's entries expire. What is written while a child runs is never repeated: the
child has time limits, which the worker must keep. An error that does not pass with time still ends the loop: the
supervisor of the worker starts another.

Methods of RQ that are overridden, as read in RQ 2.12 (tests/worker/test_rq_interface.py compares their signatures):
- repeated until accepted: register_birth, subscribe, check_for_suspension, heartbeat; skipped: set_state, teardown;
- narrowed to what the service needs: handle_payload, run_maintenance_tasks. RQ's own sweep reads jobs from Redis, and
  imports the callbacks named there, in the worker itself;
- in regnf_worker.process: dequeue_job_and_maintain_ttl, execute_job, request_stop.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

from redis import Redis
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import OutOfMemoryError, ReadOnlyError, RedisError, ResponseError
from redis.exceptions import TimeoutError as RedisTimeoutError
from rq import Worker, worker_registration
from rq.exceptions import StopRequested
from rq.registry import StartedJobRegistry
from rq.utils import current_timestamp, now

from regnf_state.queue import Work
from regnf_state.records import FieldRecord, UnreadableRecordError
from regnf_state.redis.counters import count
from regnf_state.redis.documents import text
from regnf_state.redis.fair_queue import LISTS
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.queue import JobQueue
from regnf_state.transitions import fields_of
from regnf_worker import kernel

_FIRST_WAIT_S = 0.1
MAX_WAIT_S = 2.0
_PASSING = (RedisConnectionError, RedisTimeoutError, OutOfMemoryError, ReadOnlyError)
_PASSING_WORDS = ("MISCONF ", "OOM ")
"""No class of their own: a disk that Redis cannot write to, and what older servers say of a script without memory."""
_LIVE_FOR_S = 45
"""A worker that has not reported for this long is not counted as live."""
_SHOWN = 120
_Value = TypeVar("_Value")
logger = logging.getLogger(__name__)


def passes(error: RedisError) -> bool:
    """Whether the same command may succeed later. Waiting does not help with any other error."""
    return isinstance(error, _PASSING) or any(word in str(error) for word in _PASSING_WORDS)


def retry_until_available(what: str, do: Callable[[], _Value], stopped: Callable[[], bool] = lambda: False) -> _Value:
    """What ``do`` returns once Redis accepts it, however long that takes; ``do`` may be called several times.

    Raises StopRequested when ``stopped`` by then, and any error that does not pass.
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
                raise StopRequested from error
            if not refusals:
                logger.warning("%s: Redis refuses the command; trying again: %s", what, error)
            refusals += 1
            time.sleep(wait_s)
            wait_s = min(2 * wait_s, MAX_WAIT_S)
        else:
            if refusals:
                logger.warning("%s: done after %d refusals", what, refusals)
            return value


class ResilientWorker(Worker):
    """An RQ worker that survives a Redis that is full or away, and reacts to SIGTERM while it waits for it."""

    max_connection_wait_time = MAX_WAIT_S

    def _until_available(self, what: str, do: Callable[[], _Value]) -> _Value:
        return retry_until_available(what, do, stopped=lambda: self._stop_requested)

    def _if_possible(self, what: str, do: Callable[[], object]) -> None:
        try:
            do()
        except RedisError as error:
            self.log.warning("%s is skipped: %s", what, error)

    def register_birth(self) -> None:
        register: Callable[[], None] = super().register_birth

        def register_anew() -> None:
            self.connection.delete(self.key)  # an entry whose answer was lost would look like another worker's
            register()

        self._until_available("registering the worker", register_anew)

    def subscribe(self) -> None:
        self._until_available("subscribing to commands", super().subscribe)

    def check_for_suspension(self, burst: bool) -> None:
        self._until_available("looking for a suspension", partial(super().check_for_suspension, burst))

    def heartbeat(self, timeout: int | None = None, pipeline: Any = None) -> None:  # noqa: ARG002 - one time for all
        """The whole registration again each time: Redis may have been emptied, or others have swept it as expired."""
        if pipeline is None:
            (self._if_possible if self._horse_pid else self._until_available)("a sign of life", self._report)
            return
        super().heartbeat(_LIVE_FOR_S, pipeline)
        pipeline.hset(self.key, mapping=self.serialize())
        worker_registration.register(self, pipeline)

    def _report(self) -> None:
        with self.connection.pipeline() as pipeline:
            self.heartbeat(pipeline=pipeline)
            pipeline.execute()

    def set_state(self, state: str, pipeline: Any = None) -> None:
        self._if_possible("showing the worker's state", partial(super().set_state, state, pipeline))

    def run_maintenance_tasks(self) -> None:
        """Drop entries of jobs and workers that have expired. No job is read, and none is brought back."""
        self.last_cleaned_at = now()  # type: ignore[assignment]
        self._if_possible("sweeping RQ's entries", self._sweep_entries)

    def _sweep_entries(self) -> None:
        for queue in self.queues:
            key = StartedJobRegistry.key_template.format(queue.name)
            self.connection.zremrangebyscore(key, 0, current_timestamp())
            worker_registration.clean_worker_registry(queue)

    def handle_payload(self, message: Any) -> None:
        """A command over Redis: only the order to stop the job that runs is obeyed."""
        try:
            command = json.loads(message["data"])
        except (ValueError, TypeError, RecursionError):
            command = None
        current = self.execution
        match command:
            case {"command": "stop-job", "job_id": str(name)} if current is not None and name == current.job_id:
                if self._horse_pid:
                    kernel.kill_group(self._horse_pid)
            case _:
                self.log.info("a command for another job than that of this worker is ignored")

    def teardown(self) -> None:
        """A worker that cannot sign off is not counted any more once its last report has expired."""
        self._if_possible("signing off", super().teardown)


class Taken(NamedTuple):
    """A name that has left RQ's list of a queue. key: of the hash that lies under this name."""

    queue_name: str
    name: str
    key: bytes


class Taking:
    """Takes work for one worker. Everything may raise RedisError, and may be called again after that.

    What this service has not queued is removed, logged and counted, and never run. A registration whose fields are
    still being imported is parked.
    """

    def __init__(self, redis: Redis, queue: JobQueue) -> None:
        self._redis = redis
        self._queue = queue
        self.records = RecordStore(redis)  # without the journal: its storage does not survive the worker's forks

    def pop(self, timeout: int | None) -> Taken | None:
        """The next name, waited for so many seconds (None: not at all); None when there is none."""
        self._queue.turn()
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
        self._queue.turn()  # the next in turn is for the next worker
        try:
            held: Any = self._redis.hgetall(taken.key)
            work = self._queue.read(taken.queue_name, taken.name, held) if held else None  # it was stopped meanwhile
        except ValueError as error:
            self._refuse(taken, str(error))
            return None
        except ResponseError as error:
            if not str(error).startswith("WRONGTYPE"):
                raise
            self._refuse(taken, "not a hash")
            return None
        try:
            return None if work is None or (work.kind == "registration" and self._is_parked(work)) else work
        except UnreadableRecordError as error:
            logger.error("%s: %s", taken.name, error)
            return work  # whose process says so

    def _refuse(self, taken: Taken, why: str) -> None:
        self._queue.remove(taken.name)
        self._redis.delete(taken.key)
        count(self._redis, "queue_payloads_refused", taken.queue_name)
        logger.error("%s: %a is not run and removed: %s", taken.queue_name, taken.name[:_SHOWN], why)

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
