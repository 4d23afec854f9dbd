"""The worker process: takes ids from the queue, forks a child for each, limits it, and settles the job's record.

It is RQ's forking worker with these additions: children end with the worker, time limits also stop native code, a Redis
that is full or away does not end the worker, and after a child's death no record says that the job still runs. The
worker never loads torch itself: the forked children of a process that has run a torch operation hang.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

from redis.exceptions import RedisError
from rq.exceptions import StopRequested
from rq.serializers import JSONSerializer
from rq.utils import now

from regnf_state.queue import IMPORT_QUEUE_NAME, QUEUE_NAME
from regnf_state.records import UnreadableRecordError
from regnf_state.redis.client import connect
from regnf_state.redis.queue import attempt_of
from regnf_worker import kernel
from regnf_worker.context import Context
from regnf_worker.job_limits import JobLimits
from regnf_worker.resilient_worker import ResilientWorker
from regnf_worker.scratch import Scratch
from regnf_worker.settle import ChildExit, settle_import, settle_registration

_IDLE_REPORT_S = 30
_LATE_GRACE_S = 10.0
"""After its time limit a job has this long to write down that it was too slow; then it is killed."""
_IMPORT_MARGIN_S = 30


class RegnfWorker(ResilientWorker):
    """One worker of the service. ``monitor_s`` is how often it checks the child that it runs."""

    def __init__(self, context: Context, scratch: Scratch, monitor_s: int = 1) -> None:
        assert context.settings.redis_url is not None
        super().__init__(
            [IMPORT_QUEUE_NAME, QUEUE_NAME],
            connection=connect(context.settings.redis_url, retries=20),
            serializer=JSONSerializer,
            worker_ttl=_IDLE_REPORT_S,
            job_monitoring_interval=monitor_s,
            log_job_description=False,
        )
        self._context = context
        self._scratch = scratch
        self._settlers: dict[str, Callable[[Context, str, int, str, ChildExit], None]] = {
            IMPORT_QUEUE_NAME: settle_import,
            QUEUE_NAME: settle_registration,
        }
        self._limits = {
            IMPORT_QUEUE_NAME: context.settings.import_timeout_s + _IMPORT_MARGIN_S,
            QUEUE_NAME: context.settings.job_timeout_s,
        }
        self._job_limits = JobLimits.of(context.settings)
        self._exceeded: str | None = None
        self._started = 0.0
        self._limit_s = 0.0
        self._late = False
        self._give_back_at: float | None = None
        self._given_back = False

    def serve(self) -> None:
        """Work until told to stop, be it while starting."""
        signal.signal(signal.SIGINT, self.request_stop)
        signal.signal(signal.SIGTERM, self.request_stop)
        try:
            self.work(logging_level=None)
        except StopRequested:
            self.teardown()

    # one job

    def execute_job(self, job: Any, queue: Any) -> None:
        """Run one job in a child, limit it, and settle its record. A job that is taken and not begun is in no queue
        any more: the reaper puts it back.
        """
        job.timeout = self._limit_s = self._limits[queue.name]
        self._started = time.monotonic()
        self._late = self._given_back = False
        self._exceeded = None
        oom_kills = kernel.oom_kills()
        self.begin_job(job)
        try:
            end = self._run_child(job, queue)
        finally:
            self._scratch.empty()
        try:
            self.finish_job(job, queue, end.status)
        finally:
            self._settle(job, queue, end, kernel.oom_kills() > oom_kills)

    def _run_child(self, job: Any, queue: Any) -> kernel.Exit:
        """Fork a child for the job and wait for its end."""
        limited = _is_limited(queue)
        ended, held_by_child = os.pipe()
        parent = os.getpid()
        child = os.fork()
        if child == 0:
            os.setpgrp()
            kernel.die_with_parent(parent)
            kernel.prefer_as_oom_victim()
            self._scratch.use()
            if limited:
                self._job_limits.hold_here()
            self.main_work_horse(job, queue)
            os._exit(0)
        os.close(held_by_child)
        self._horse_pid = child
        job.started_at = now()
        job.timeout = -1  # the limit is kept here, by the monotonic clock: RQ uses the wall clock
        try:
            while (exit_ := kernel.wait_for_exit(child, ended, self.job_monitoring_interval)) is None:
                self._limit_child(limited)
                self.report_running(job)
        finally:
            os.close(ended)
        self._horse_pid = 0
        return exit_

    def _limit_child(self, limited: bool) -> None:
        """Kill a child that is past its time limit, past the time that a worker which stops grants it, or, ``limited``,
        over a limit of its memory or disk space."""
        now_s = time.monotonic()
        if now_s - self._started > self._limit_s + _LATE_GRACE_S:
            self._late = True
            self.kill_horse()
        elif self._give_back_at is not None and now_s >= self._give_back_at:
            self._given_back = True
            self.kill_horse()
        elif limited:
            self._exceeded = self._job_limits.exceeded_by(self._horse_pid, self._scratch.folder)
            if self._exceeded is not None:
                self.kill_horse()

    def _settle(self, job: Any, queue: Any, ended: kernel.Exit, out_of_memory: bool) -> None:
        status = ended.status
        end = ChildExit(
            signal=os.WTERMSIG(status) if status is not None and os.WIFSIGNALED(status) else None,
            late=self._late or time.monotonic() - self._started >= self._limit_s,
            out_of_memory=out_of_memory,
            given_back=self._given_back,
            exceeded=self._exceeded,
            crashed_near_limit=_is_limited(queue) and bool(status) and self._job_limits.is_near(ended.peak_memory),
            limits=self._job_limits,
        )
        settle = self._settlers[queue.name]

        def write_down() -> None:
            try:
                self._until_available(
                    f"settling job {job.id}",
                    lambda: settle(self._context, job.args[0], attempt_of(job.id), self.name, end),
                )
            except (RedisError, OSError, UnreadableRecordError) as error:
                self.log.error("job %s could not be settled: %s", job.id, error)  # the reaper will

        if self._context.settings.storage_url is None:
            write_down()
        elif not kernel.in_child(write_down):  # a client of an object store does not survive the forks to come
            self.log.error("job %s could not be settled: the process that should have has died", job.id)

    # the worker itself

    def request_stop(self, signum: int, frame: FrameType | None) -> None:
        """Told to stop: a running job has ``shutdown_grace_s`` to end, then goes back to the queue."""
        self._give_back_at = time.monotonic() + self._context.settings.shutdown_grace_s
        super().request_stop(signum, frame)  # type: ignore[no-untyped-call]

    def request_force_stop(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002
        """Told to stop again: at once."""
        self._give_back_at = time.monotonic()


def _is_limited(queue: Any) -> bool:
    """Whether the worker limits a job of this queue: an import's process has limits of its own."""
    return bool(queue.name != IMPORT_QUEUE_NAME)
