"""RQ's worker, made to survive a Redis that refuses commands: RQ's own loop ends at the first one.

There are three kinds of calls:
- What must succeed before the worker continues, such as its sign of life, is repeated until Redis accepts it. A worker
  that cannot write takes nothing from the queue.
- What only keeps RQ's own entries tidy is skipped: job records are the truth, and RQ's entries expire or are swept.
- What is written while a child runs is never repeated: the child has time limits, which the worker must keep.

An error that does not pass with time still ends the loop: the supervisor of the worker starts another.

Methods of RQ that are overridden, as read in RQ 2.12 (tests/worker/test_rq_interface.py compares their signatures):
- repeated until accepted: register_birth, subscribe, check_for_suspension, prepare_job_execution, heartbeat;
- skipped when refused: set_state, run_maintenance_tasks, teardown; set_shutdown_requested_date does nothing;
- narrowed to what the service needs: handle_payload, clean_registries. RQ's own read jobs from Redis, and import the
  callbacks named there, in the worker itself;
- in regnf_worker.process: dequeue_job_and_maintain_ttl, execute_job, main_work_horse, request_stop,
  request_force_stop.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from redis import Redis
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import OutOfMemoryError, ReadOnlyError, RedisError, ResponseError
from redis.exceptions import TimeoutError as RedisTimeoutError
from rq import Worker, worker_registration
from rq.exceptions import StopRequested
from rq.executions import ExecutionRegistry
from rq.registry import FailedJobRegistry, FinishedJobRegistry, StartedJobRegistry
from rq.utils import current_timestamp, now
from rq.worker import WorkerStatus

from regnf_state.queue import IMPORT_QUEUE_NAME, QUEUE_NAME, Work
from regnf_state.records import FieldRecord, JobRecord, UnreadableRecordError
from regnf_state.redis import queue
from regnf_state.redis.counters import count
from regnf_state.redis.documents import text
from regnf_state.redis.fair_queue import FairQueue
from regnf_state.redis.jobs import RecordStore
from regnf_state.transitions import fields_of

# Waiting for a Redis that is full, away or read-only.

_FIRST_WAIT_S = 0.1
MAX_WAIT_S = 2.0
_PASSING = (RedisConnectionError, RedisTimeoutError, OutOfMemoryError, ReadOnlyError)
_PASSING_WORDS = ("MISCONF ", "OOM ")
"""No class of their own: a disk that Redis cannot write to, and what older servers say of a script without memory."""
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
                logger.warning("%s: Redis refuses, trying until it does not: %s", what, error)
            refusals += 1
            time.sleep(wait_s)
            wait_s = min(2 * wait_s, MAX_WAIT_S)
        else:
            if refusals:
                logger.warning("%s: done after %d refusals", what, refusals)
            return value


_LIVE_FOR_S = 45
"""A worker that has not reported for this long is not counted as live."""
_Value = TypeVar("_Value")


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

    # repeated until Redis accepts it

    def register_birth(self) -> None:
        register: Callable[[], None] = super().register_birth

        def register_anew() -> None:
            self.connection.delete(self.key)  # an entry whose answer was lost would look like another worker's
            register()

        self._until_available("registering the worker", register_anew)

    def subscribe(self) -> None:
        self._until_available("subscribing to commands", super().subscribe)

    def check_for_suspension(self, burst: bool) -> None:
        look = super().check_for_suspension
        self._until_available("looking for a suspension", lambda: look(burst))

    def prepare_job_execution(self, job: Any, remove_from_intermediate_queue: bool = False) -> None:
        prepare = super().prepare_job_execution
        self._until_available(f"beginning job {job.id}", lambda: prepare(job, remove_from_intermediate_queue))

    def heartbeat(self, timeout: int | None = None, pipeline: Any = None) -> None:  # noqa: ARG002 - one time for all
        if pipeline is not None:
            self._report(pipeline)
        elif self._horse_pid:
            self._if_possible("a sign of life", self._report_now)
        else:
            self._until_available("a sign of life", self._report_now)

    def _report(self, pipeline: Any) -> None:
        """The whole registration again each time: Redis may have been emptied, or others have swept it as expired."""
        super().heartbeat(_LIVE_FOR_S, pipeline)
        pipeline.hset(self.key, mapping=self.serialize())
        worker_registration.register(self, pipeline)

    def _report_now(self) -> None:
        with self.connection.pipeline() as pipeline:
            self._report(pipeline)
            pipeline.execute()

    # skipped when Redis refuses it

    def set_state(self, state: str, pipeline: Any = None) -> None:
        show = super().set_state
        self._if_possible("showing the worker's state", lambda: show(state, pipeline))

    def run_maintenance_tasks(self) -> None:
        self._if_possible("sweeping RQ's entries", self.clean_registries)

    def clean_registries(self) -> None:
        """Drop RQ's entries that have expired, and workers that have. No job is read, and none is brought back."""
        self.last_cleaned_at = now()  # type: ignore[assignment]
        with self.connection.pipeline() as pipeline:
            for queue in self.queues:
                for registry in (StartedJobRegistry, FinishedJobRegistry, FailedJobRegistry):
                    pipeline.zremrangebyscore(registry.key_template.format(queue.name), 0, current_timestamp())
            pipeline.execute()
        for queue in self.queues:
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
                    self.kill_horse()
            case _:
                self.log.info("a command that is not for the job of this worker is ignored")

    def set_shutdown_requested_date(self) -> None:
        """Nobody reads it, and the handler of a signal must not wait for Redis."""

    def teardown(self) -> None:
        """A worker that cannot sign off is not counted any more once its last report has expired."""
        self._if_possible("signing off", super().teardown)

    # around a job: for ``execute_job``

    def begin_job(self, job: Any) -> None:
        """Enter the job as taken up by this worker."""
        self._until_available(f"taking up job {job.id}", lambda: self.prepare_execution(job))

    def report_running(self, job: Any) -> None:
        """Renew the entries of worker and job while a child runs."""
        self._if_possible(f"a sign of life of job {job.id}", lambda: self.maintain_heartbeats(job))

    def finish_job(self, job: Any) -> None:
        """Drop RQ's entries on a job whose child has ended. The outcome is written to the job's own record."""
        self._if_possible(f"closing RQ's entries on job {job.id}", lambda: self._drop_entries(job))
        self.set_state(WorkerStatus.IDLE)

    def _drop_entries(self, job: Any) -> None:
        with self.connection.pipeline() as pipeline:
            self.cleanup_execution(job, pipeline)
            pipeline.delete(job.key, ExecutionRegistry(job.id, connection=self.connection).key)
            pipeline.execute()


# The pipe between a job's process and its worker: closed, the process has ended; a byte, the worker may go on.
#
# A process says so once its result is out. What it still does, the worker lets it do beside the next job.

_writing: list[int] = []
"""The end that this process holds, if it is a job's."""


def hold(writing: int) -> None:
    """This process is a job's; its worker reads the other end."""
    _writing.append(writing)


def let_worker_go() -> bool:
    """Tell the worker that it need not wait for this process. False where this process is no job's, as in tests."""
    for pipe in _writing:
        os.write(pipe, b".")
    return bool(_writing)


# How a worker takes work: from the lists that the fair queue fills, and only work that the service itself has queued.
#
# What is in Redis under a name is checked and then put aside: the job is made anew from its name. Anything else is
# removed, logged and counted, and never run. A registration whose fields are still being imported is parked.

LISTS = {f"rq:queue:{name}": name for name in (IMPORT_QUEUE_NAME, QUEUE_NAME)}
_SHOWN = 120


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
        self._records = RecordStore(redis)  # without the journal: its storage does not survive the worker's forks

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
            return None  # it was stopped meanwhile
        try:
            work = queue.read(taken.queue_name, taken.name, held, self._redis, self._key)
        except queue.PayloadError as error:
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
