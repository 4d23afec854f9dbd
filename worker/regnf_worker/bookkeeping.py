"""RQ's worker as one that Redis can refuse: RQ's own ends its loop at the first write that is not taken.

Three kinds of calls:
- what must be so before the worker goes on, such as saying that it lives, is tried until Redis takes it. A worker that
  cannot write takes nothing from the queue;
- what only keeps RQ's books tidy is left undone: job records are the truth, RQ's entries expire or are swept later;
- what is written while a child runs never waits, for the child has time limits to be kept.

An error that waiting does not mend still ends the loop: whoever supervises the worker starts another.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from redis.exceptions import RedisError
from rq import Worker, worker_registration

from regnf_worker.retry import MAX_WAIT_S, retry_until_available

_LIVE_FOR_S = 45
"""A worker that has not reported for this long is not counted as live."""
_Value = TypeVar("_Value")


class ResilientWorker(Worker):
    """An RQ worker that outlives a Redis that is full or away, and hears SIGTERM while it waits for it."""

    max_connection_wait_time = MAX_WAIT_S

    def _until_available(self, what: str, do: Callable[[], _Value]) -> _Value:
        return retry_until_available(what, do, stopped=lambda: self._stop_requested)

    def _if_possible(self, what: str, do: Callable[[], object]) -> None:
        try:
            do()
        except RedisError as error:
            self.log.warning("%s is left undone: %s", what, error)

    # tried until Redis takes it

    def register_birth(self) -> None:
        birth: Callable[[], None] = super().register_birth

        def be_born() -> None:
            self.connection.delete(self.key)  # a birth whose answer was lost would pass for another worker's
            birth()

        self._until_available("registering the worker", be_born)

    def subscribe(self) -> None:
        self._until_available("subscribing to commands", super().subscribe)

    def check_for_suspension(self, burst: bool) -> None:
        look = super().check_for_suspension
        self._until_available("looking for a suspension", lambda: look(burst))

    def dequeue_job_and_maintain_ttl(self, timeout: int | None, max_idle_time: int | None = None) -> Any:
        take = super().dequeue_job_and_maintain_ttl
        return self._until_available("taking a job", lambda: take(timeout, max_idle_time))

    def prepare_execution(self, job: Any) -> Any:
        prepare = super().prepare_execution
        return self._until_available(f"taking up job {job.id}", lambda: prepare(job))

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

    # left undone

    def set_state(self, state: str, pipeline: Any = None) -> None:
        show = super().set_state
        self._if_possible("showing the worker's state", lambda: show(state, pipeline))

    def run_maintenance_tasks(self) -> None:
        """A lock that is left behind runs out after a quarter of an hour."""
        self._if_possible("sweeping RQ's books", super().run_maintenance_tasks)

    def set_shutdown_requested_date(self) -> None:
        """Nobody reads it, and the handler of a signal is no place to wait for Redis."""

    def teardown(self) -> None:
        """A worker that cannot say goodbye is not counted any more once its last report has expired."""
        self._if_possible("the farewell", super().teardown)

    # while a child runs, and right after

    def maintain_heartbeats(self, job: Any) -> None:
        maintain = super().maintain_heartbeats
        self._if_possible(f"a sign of life of job {job.id}", lambda: maintain(job))

    def set_current_job_working_time(self, current_job_working_time: float, pipeline: Any = None) -> None:
        show = super().set_current_job_working_time
        self._if_possible("showing how long a job runs", lambda: show(current_job_working_time, pipeline))

    def monitor_work_horse(self, job: Any, queue: Any) -> None:
        """Returns when the child has ended. How that went is settled in the job's record, not in RQ's books."""
        try:
            super().monitor_work_horse(job, queue)
        except RedisError as error:
            if self._horse_pid:
                raise
            self.log.warning("RQ's books on job %s are left as they are: %s", job.id, error)
