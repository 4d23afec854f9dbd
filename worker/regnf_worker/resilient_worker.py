"""RQ's worker, made to survive a Redis that refuses commands: RQ's own loop ends at the first one.

There are three kinds of calls:
- What must succeed before the worker continues, such as its sign of life, is repeated until Redis accepts it. A worker
  that cannot write takes nothing from the queue.
- What only keeps RQ's own entries tidy is skipped: job records are the truth, and RQ's entries expire or are swept.
- What is written while a child runs is never repeated: the child has time limits, which the worker must keep.

An error that does not pass with time still ends the loop: the supervisor of the worker starts another.

Methods of RQ that are overridden, as read in RQ 2.12 (tests/worker/test_rq_interface.py compares their signatures):
- repeated until accepted: register_birth, subscribe, check_for_suspension, dequeue_job_and_maintain_ttl,
  prepare_job_execution, heartbeat;
- skipped when refused: set_state, run_maintenance_tasks, teardown; set_shutdown_requested_date does nothing;
- in regnf_worker.process: execute_job, request_stop, request_force_stop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from redis.exceptions import RedisError
from rq import Worker, worker_registration
from rq.exceptions import InvalidJobOperation
from rq.job import JobStatus
from rq.utils import now
from rq.worker import WorkerStatus

from regnf_worker.retry import MAX_WAIT_S, retry_until_available

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

    def dequeue_job_and_maintain_ttl(self, timeout: int | None, max_idle_time: int | None = None) -> Any:
        take = super().dequeue_job_and_maintain_ttl
        return self._until_available("taking a job", lambda: take(timeout, max_idle_time))

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
        """A lock that is left behind expires after a quarter of an hour."""
        self._if_possible("sweeping RQ's entries", super().run_maintenance_tasks)

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

    def finish_job(self, job: Any, queue: Any, status: int | None) -> None:
        """Close RQ's entries on a job whose child has ended with this status of waitpid.

        The outcome is written to the job's own record elsewhere; RQ's entries are only tidied.
        """
        if status != 0:
            self._if_possible(f"closing RQ's entries on job {job.id}", lambda: self._enter_failure(job, queue))
        self.set_state(WorkerStatus.IDLE)

    def _enter_failure(self, job: Any, queue: Any) -> None:
        try:
            entered = job.get_status()
        except InvalidJobOperation:
            return  # it has ended, and its entry has expired
        if entered not in (JobStatus.FINISHED, JobStatus.FAILED):
            job.ended_at = now()
            self.handle_job_failure(job, queue=queue, exc_string="the process of the job ended by itself or was killed")
