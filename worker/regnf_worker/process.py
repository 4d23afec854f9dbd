"""The worker process: takes ids from the queue, forks a child for each, limits it, and settles the job's record.

It is RQ's forking worker with these additions: only two functions ever run, callers take turns, children end with the
worker, time limits also stop native code, a Redis that is full or away does not end the worker, and after a child's
death no record says that the job still runs. The worker never loads torch itself: the forked children of a process that
has run a torch operation hang.
"""

from __future__ import annotations

import logging
import os
import random
import signal
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from redis import Redis
from redis.exceptions import RedisError
from rq import Queue
from rq.exceptions import StopRequested
from rq.serializers import JSONSerializer
from rq.timeouts import JobTimeoutException
from rq.utils import now
from rq.worker import WorkerStatus

from regnf_core.importing.gate.child import LONGEST
from regnf_state.queue import IMPORT_QUEUE_NAME, QUEUE_NAME, Kind, Work
from regnf_state.records import UnreadableRecordError
from regnf_state.redis import queue as payload
from regnf_state.redis.client import WORKER_RETRIES, connect, redis_address
from regnf_state.redis.fair_queue import FairQueue
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.queue import JobQueue
from regnf_worker import jobs, kernel, resilient_worker
from regnf_worker.job_limits import JobLimits, start_refused
from regnf_worker.jobs import Draw, FieldDrawer
from regnf_worker.kernel import Scratch
from regnf_worker.models import Context, is_unmodeled_entry
from regnf_worker.resilient_worker import ResilientWorker, Taking
from regnf_worker.settle import ChildExit, give_up_rest, settle_import, settle_registration

# The job process that is still at the pictures of a result which is out. The worker goes on meanwhile.

_DEATH_S = 10.0
"""A killed process is gone within this time."""


@dataclass(frozen=True)
class ChildAtPictures:
    """Such a process. ended: the reading end of its pipe · until: when it has had its time, by the monotonic clock ·
    on_end: called once it is gone."""

    pid: int
    ended: int
    until: float
    on_end: Callable[[], None]


class Finishing:
    """One such process at most."""

    def __init__(self) -> None:
        self._child: ChildAtPictures | None = None

    def take(self, child: ChildAtPictures) -> None:
        """Look after a process, once there is no other."""
        self._child = child

    def is_free(self, seconds: float = 0.0) -> bool:
        """Whether there is none any more, waited for so many seconds at most. One that has had its time is killed."""
        child = self._child
        if child is None:
            return True
        if time.monotonic() >= child.until:
            self._kill(child)
        if not isinstance(kernel.wait_for_exit(child.pid, child.ended, seconds), kernel.Exit):
            return False
        self._child = None
        os.close(child.ended)
        child.on_end()
        return True

    def end(self, grace_s: float) -> None:
        """The worker stops: what is not made within its grace is missing."""
        if not self.is_free(grace_s) and self._child is not None:
            self._kill(self._child)
            self.is_free(_DEATH_S)

    @staticmethod
    def _kill(child: ChildAtPictures) -> None:
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)


# Fields that became a library's entries while their import ran.
#
# Such an import may have looked for the entry too early, and work that runs is not queued a second time. So the
# worker looks once more when the import's process has ended.

logger = logging.getLogger(__name__)


class LateEntries:
    """For one import after the other. An import that begins with the entry has had its turn: what is no object has no
    model, and is not tried again."""

    def __init__(self, redis: Redis, queue: JobQueue) -> None:
        self._records = RecordStore(redis)  # without the journal: its storage does not survive the worker's forks
        self._queue = queue
        self._known = False

    def before(self, work: Work) -> None:
        """To be called before the import's process."""
        self._known = self._is_unmodeled(work)

    def after(self, work: Work) -> None:
        """To be called once the import is in no list any more: queues it again, for the model alone."""
        if not self._known and self._is_unmodeled(work):
            try:
                self._queue.enqueue_import(work.argument, work.attempt)
            except RedisError as error:
                logger.warning("the model of entry %s is left to its first job: %s", work.argument, error)

    def _is_unmodeled(self, work: Work) -> bool:
        try:
            return is_unmodeled_entry(self._records, work.argument, work.attempt)
        except (RedisError, UnreadableRecordError) as error:
            logger.warning("whether %s is an entry without a model is not known: %s", work.argument, error)
            return False


Function = Callable[[str, int, str], None]
"""(job's id or field's reference, attempt, worker)."""
FUNCTIONS: Mapping[Kind, Function] = {"import": jobs.run_import, "registration": jobs.run_registration}
"""Everything that a worker runs, whatever the queue says."""
_IDLE_REPORT_S = 30
_LATE_GRACE_S = 10.0
"""After its time limit a job has this long to write down that it was too slow; then it is killed."""
_IMPORT_MARGIN_S = 30


class RegnfWorker(ResilientWorker):
    """One worker of the service. ``monitor_s`` is how often it checks the child that it runs."""

    def __init__(
        self,
        context: Context,
        scratch: Scratch,
        monitor_s: int = 1,
        functions: Mapping[Kind, Function] = FUNCTIONS,
        draw: Draw = jobs.run_drawing,
    ) -> None:
        redis = connect(redis_address(context.settings), retries=WORKER_RETRIES)
        super().__init__(
            [IMPORT_QUEUE_NAME, QUEUE_NAME],
            connection=redis,
            serializer=JSONSerializer,
            worker_ttl=_IDLE_REPORT_S,
            job_monitoring_interval=monitor_s,
            log_job_description=False,
        )
        self._context = context
        self._scratch = scratch
        self._functions = functions
        self._fair = FairQueue(redis)
        self._taking = Taking(redis, self._fair, context.settings.queue_key)
        self._late_entries = LateEntries(redis, context.queue)
        self._settlers: dict[Kind, Callable[[Context, str, int, str, ChildExit], None]] = {
            "import": settle_import,
            "registration": settle_registration,
        }
        self._limits: dict[Kind, int] = {
            "import": round(LONGEST * context.settings.import_timeout_s) + _IMPORT_MARGIN_S,
            "registration": context.settings.job_timeout_s,
        }
        self._job_limits = JobLimits.of(context.settings)
        self._finishing = Finishing()
        self._drawer = FieldDrawer(redis, context.settings, draw)
        self._because: str | None = None
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
        finally:
            self._drawer.end()
            self._finishing.end(self._context.settings.shutdown_grace_s)

    def dequeue_job_and_maintain_ttl(self, timeout: int | None, max_idle_time: int | None = None) -> Any:  # noqa: ARG002
        """The next job and its queue, waited for; None when there is none and no ``timeout`` to wait for."""
        self.set_state(WorkerStatus.IDLE)
        while True:
            self.heartbeat()
            if self.should_run_maintenance_tasks:
                self.run_maintenance_tasks()
            taken = self._until_available("taking a job", partial(self._taking.pop, None))
            if taken is None and timeout is not None:
                busy = self._drawer.go_on() or not self._finishing.is_free() or self._scratch.drop_left()
                wait_s = 1 if busy else timeout
                taken = self._until_available("waiting for a job", partial(self._taking.pop, wait_s))
            if taken is None and timeout is None:
                return None
            if taken is not None:
                work = self._until_available("looking at what was taken", partial(self._taking.accept, taken))
                if work is not None:
                    self.log.info("%s: %s", work.queue_name, work.name)
                    queue = Queue(work.queue_name, connection=self.connection, serializer=JSONSerializer)
                    return payload.made(work, self.connection), queue

    # one job

    def execute_job(self, job: Any, queue: Any) -> None:
        """Run one job in a child, limit it, and settle its record. A job that is taken and not begun is in no queue
        any more: the reaper puts it back.
        """
        work = Work.named(queue.name, job.id)
        job.timeout = self._limit_s = self._limits[work.kind]
        self._started = time.monotonic()
        self._late = self._given_back = False
        self._because = None
        oom_kills = kernel.oom_kills()
        self.begin_job(job)
        if work.kind == "import":
            self._late_entries.before(work)
        folder = self._scratch.of_job()
        end = self._run_child(job, queue, folder)
        if end is not None:
            self._scratch.drop(folder)
        try:
            self.finish_job(job)
        finally:
            if end is not None:
                self._settle(work, end, kernel.oom_kills() > oom_kills)
            if work.kind == "import":
                self._if_possible("queueing what waited", lambda: self._fair.release(work.argument))
                self._late_entries.after(work)

    def main_work_horse(self, job: Any, queue: Any) -> None:
        """What the child does: it runs one of our functions, never what RQ would import."""
        random.seed()
        self.setup_work_horse_signals()  # type: ignore[no-untyped-call]
        self._is_horse = True
        work = Work.named(queue.name, job.id)
        self.prepare_job_execution(job)
        with self.death_penalty_class(job.timeout, JobTimeoutException):
            self._functions[work.kind](work.argument, work.attempt, self.name)

    def _run_child(self, job: Any, queue: Any, folder: Path) -> kernel.Exit | None:
        """Fork a child for the job and wait for its end; None when it has said that the worker may go on."""
        limited = queue.name != IMPORT_QUEUE_NAME  # an import's process has limits of its own
        try:
            child, ended = self._start_child(job, queue, folder, limited)
        except OSError as error:
            self.log.error("job %s: no process could be made for it: %s", job.id, error)
            self._because = start_refused(error)
            return kernel.Exit(None)
        with suppress(OSError):
            os.setpgid(child, child)  # the child does so too: whoever is first, before anybody kills its group
        self._horse_pid = child
        job.started_at = now()
        job.timeout = -1  # the limit is kept here, by the monotonic clock: RQ uses the wall clock
        while (exit_ := kernel.wait_for_exit(child, ended, self.job_monitoring_interval)) is None:
            self._limit_child(limited, folder)
            self.report_running(job)
            self._finishing.is_free()
        self._horse_pid = 0
        if exit_ == "spoken":
            self._let_finish(Work.named(queue.name, job.id), child, ended, folder)
            return None
        os.close(ended)
        return exit_

    def _start_child(self, job: Any, queue: Any, folder: Path, limited: bool) -> tuple[int, int]:
        """Make the job's folder and its process: the process id, and a pipe that says when it has ended. Raises
        OSError."""
        self._scratch.make(folder)
        ended, held_by_child = os.pipe()

        def run() -> None:
            os.setpgrp()
            kernel.prefer_as_oom_victim()
            os.close(ended)
            resilient_worker.hold(held_by_child)
            if limited:
                self._job_limits.hold_here()
            self._scratch.use(folder)
            self.main_work_horse(job, queue)

        try:
            return kernel.forked(run), ended
        except OSError:
            os.close(ended)
            raise
        finally:
            os.close(held_by_child)

    def _let_finish(self, work: Work, child: int, ended: int, folder: Path) -> None:
        """Leave a child to itself whose result is out; the one before it is waited for, so there is one at most."""

        def settle() -> None:
            self._scratch.drop(folder)
            self._write_down(work, lambda: give_up_rest(self._context, work.argument))
            self._sweep()

        until = time.monotonic() + self._context.settings.lost_after_s
        while not self._finishing.is_free(self.job_monitoring_interval):
            self._if_possible("a sign of life", self._report_now)
        self._finishing.take(ChildAtPictures(child, ended, until, settle))

    def _limit_child(self, limited: bool, folder: Path) -> None:
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
            self._because = self._job_limits.exceeded_by(self._horse_pid, folder)
            if self._because is not None:
                self.kill_horse()

    def _settle(self, work: Work, ended: kernel.Exit, out_of_memory: bool) -> None:
        status = ended.status
        end = ChildExit(
            signal=os.WTERMSIG(status) if status is not None and os.WIFSIGNALED(status) else None,
            late=self._late or time.monotonic() - self._started >= self._limit_s,
            out_of_memory=out_of_memory,
            given_back=self._given_back,
            because=self._because,
            crashed_near_limit=work.kind == "registration" and self._crashed_near_limit(ended),
            limits=self._job_limits,
        )
        settle = self._settlers[work.kind]

        self._write_down(work, lambda: settle(self._context, work.argument, work.attempt, self.name, end))
        if end.signal is not None:
            self._sweep()

    def _sweep(self) -> None:
        """Delete what a killed process was writing. Local files are locked while they are written; those of an object
        store are not, so housekeeping goes by their age."""
        if self._context.settings.storage_url is None:
            with suppress(OSError):
                self._context.blobs.sweep(0.0)

    def _write_down(self, work: Work, settle: Callable[[], None]) -> None:
        def write_down() -> None:
            try:
                self._until_available(f"settling job {work.name}", settle)
            except (RedisError, OSError, UnreadableRecordError) as error:
                self.log.error("job %s could not be settled: %s", work.name, error)  # the reaper will

        if self._context.settings.storage_url is None:
            write_down()
        elif not kernel.in_child(write_down):  # a client of an object store does not survive the forks to come
            self.log.error("job %s could not be settled: the process that should have has died", work.name)

    def _crashed_near_limit(self, ended: kernel.Exit) -> bool:
        """Whether a process has ended by itself, by no exception of ours, with most of its memory in use."""
        crashed = bool(ended.status) and os.waitstatus_to_exitcode(ended.status or 0) != kernel.RAISED
        return crashed and self._job_limits.is_near(ended.peak_memory)

    # the worker itself

    def request_stop(self, signum: int, frame: FrameType | None) -> None:
        """Told to stop: a running job has ``shutdown_grace_s`` to end, then goes back to the queue."""
        self._give_back_at = time.monotonic() + self._context.settings.shutdown_grace_s
        super().request_stop(signum, frame)  # type: ignore[no-untyped-call]

    def request_force_stop(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002
        """Told to stop again: at once."""
        self._give_back_at = time.monotonic()
