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
from collections.abc import Callable
from typing import Any, TypeVar

from redis.exceptions import RedisError
from rq import Worker, worker_registration
from rq.executions import ExecutionRegistry
from rq.registry import FailedJobRegistry, FinishedJobRegistry, StartedJobRegistry
from rq.utils import current_timestamp, now
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
