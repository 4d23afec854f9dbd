"""The worker process: takes ids from the queue, forks a child for each, limits it, and settles the job's record.

It is RQ's forking worker, with these additions: only two functions ever run, children end with the worker, time limits
also stop native code, and after a child's death no record says that the job still runs. The worker never runs a torch
operation itself: the forked children of a process that has hang.
"""

from __future__ import annotations

import json
import logging
import os
import random
import signal
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from redis.exceptions import RedisError
from rq import Queue
from rq.exceptions import StopRequested
from rq.serializers import JSONSerializer
from rq.timeouts import JobTimeoutException
from rq.worker import WorkerStatus

from regnf_core.importing.gate.child import LONGEST
from regnf_core.importing.gate.gate import start_early
from regnf_core.processes import keep_freed_memory
from regnf_state.queue import IMPORT_QUEUE_NAME, QUEUE_NAME, Kind, Work
from regnf_state.records import UnreadableRecordError
from regnf_state.redis.client import WORKER_RETRIES, connect, redis_address
from regnf_state.redis.queue import JobQueue, made
from regnf_worker import jobs, kernel, pictures
from regnf_worker.job_limits import JobLimits, start_refused
from regnf_worker.jobs import Draw, FieldDrawer
from regnf_worker.kernel import Scratch
from regnf_worker.models import Context, is_unmodeled_entry
from regnf_worker.pictures import ChildAtPictures, Finishing, give_up_rest
from regnf_worker.resilient_worker import ResilientWorker, Taking
from regnf_worker.settle import ChildExit, settle_import, settle_registration

Function = Callable[[str, int, str], None]
"""(job's id or field's reference, attempt, worker)."""
FUNCTIONS = {"import": jobs.run_import, "registration": jobs.run_registration}
"""Everything that a worker runs, whatever the queue says. Each is given the worker's settings first."""
_LATE_GRACE_S = 10.0
"""After its time limit a job has this long to write down that it was too slow; then it is killed."""
_IMPORT_MARGIN_S = 30
_FIRST_REPORT_S = 30
"""A minute more than this, RQ counts a worker as live that has not reported yet."""
_MONITOR_S = 1
"""How often the worker checks the child that it runs, and whether it shall stop."""
logger = logging.getLogger(__name__)


class RegnfWorker(ResilientWorker):
    """One worker of the service."""

    def __init__(
        self,
        context: Context,
        scratch: Scratch,
        functions: Mapping[Kind, Function] | None = None,
        draw: Draw = jobs.run_drawing,
    ) -> None:
        redis = connect(redis_address(context.settings), retries=WORKER_RETRIES)
        super().__init__(
            [IMPORT_QUEUE_NAME, QUEUE_NAME],
            connection=redis,
            serializer=JSONSerializer,
            worker_ttl=_FIRST_REPORT_S,
            job_monitoring_interval=_MONITOR_S,
            log_job_description=False,
        )
        self._context = context
        self._scratch = scratch
        usual = {kind: partial(function, context.settings) for kind, function in FUNCTIONS.items()}
        self._functions: Mapping[Any, Function] = functions if functions is not None else usual
        self._queue = JobQueue(redis, context.settings.queue_key)
        self._taking = Taking(redis, self._queue)
        self._limits: dict[Kind, int] = {
            "import": round(LONGEST * context.settings.import_timeout_s) + _IMPORT_MARGIN_S,
            "registration": context.settings.job_timeout_s,
        }
        self._job_limits = JobLimits.of(context.settings)
        self._finishing = Finishing()
        self._drawer = FieldDrawer(redis, context.settings, draw)
        self._because: str | None = None
        self._expects_recordings = False
        self._next_import: tuple[int, int] | None = None
        self._started = 0.0
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

    def request_stop(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002 -- what handlers are given
        """A running job has ``shutdown_grace_s`` to end, then goes back to the queue. Told again: at once."""
        grace_s = 0.0 if self._stop_requested else self._context.settings.shutdown_grace_s
        self._give_back_at = time.monotonic() + grace_s
        self._stop_requested = True

    def dequeue_job_and_maintain_ttl(self, timeout: int | None, max_idle_time: int | None = None) -> Any:  # noqa: ARG002
        """The next job and its queue, waited for; None once told to stop, and without a ``timeout`` if none waits."""
        self.set_state(WorkerStatus.IDLE)
        while not self._stop_requested:
            self.heartbeat()
            if self.should_run_maintenance_tasks:
                self.run_maintenance_tasks()
            taken = self._until_available("taking a job", partial(self._taking.pop, None))
            if taken is None and timeout is None:
                return None
            if taken is None:
                self._drawer.go_on()
                self._finishing.is_free()
                self._scratch.drop_left()
                self._prepare_import()
                taken = self._until_available("waiting for a job", partial(self._taking.pop, _MONITOR_S))
            if taken is not None:
                work = self._until_available("checking the job that was taken", partial(self._taking.accept, taken))
                if work is not None:
                    return made(work, self.connection), Queue(work.queue_name, connection=self.connection)
        return None

    # one job

    def execute_job(self, job: Any, queue: Any) -> None:
        """Run one job in a child, limit it, and settle its record. A job that is taken and not begun is in no queue
        any more: the reaper puts it back.
        """
        work = Work.named(queue.name, job.id)
        self.log.info("%s: %s", work.queue_name, work.name)
        self._started = time.monotonic()
        self._late = self._given_back = False
        self._because = None
        oom_kills = kernel.oom_kills()
        self._until_available(f"taking up job {work.name}", lambda: self.prepare_execution(job))
        self._until_available(f"beginning job {work.name}", lambda: self.prepare_job_execution(job))
        was_entry = self._is_unmodeled(work, otherwise=True)
        folder = self._scratch.of_job()
        end = self._run_child(job, work, folder)
        if end is not None:
            self._scratch.drop(folder)
        self._if_possible(f"closing RQ's entries on job {work.name}", lambda: self._drop_entries(job))
        if end is not None:
            self._settle(work, end, kernel.oom_kills() > oom_kills)
        if work.kind == "import":
            self._if_possible("queueing what waited", lambda: self._queue.release(work.argument))
            with suppress(RedisError, UnreadableRecordError):
                field = self._taking.records.get_field(work.argument)
                self._expects_recordings = field is not None and field.is_recording
        if not was_entry and self._is_unmodeled(work, otherwise=False):
            # became a library's entry too late for its import to see it, and work that runs is not queued twice
            self._if_possible("modeling an entry", lambda: self._queue.enqueue_import(work.argument, work.attempt))

    def _is_unmodeled(self, work: Work, otherwise: bool) -> bool:
        """Whether an import's field is an entry without a model; ``otherwise`` where that cannot be told now."""
        try:
            return work.kind == "import" and is_unmodeled_entry(self._taking.records, work.argument, work.attempt)
        except (RedisError, UnreadableRecordError) as error:
            logger.warning("it is not known whether %s is an entry without a model: %s", work.argument, error)
            return otherwise

    def _prepare_import(self) -> None:
        """After a recording, have the process of the next import wait for it: frames come one after another, somebody
        waits for each, and to load what reads one takes several times as long as to read it."""
        if self._expects_recordings and self._next_import is None:
            with suppress(OSError):
                self._next_import = self._forked(lambda: start_early("regnf_data.recordings.importing"))

    def _drop_entries(self, job: Any) -> None:
        """The outcome is written to the job's own record."""
        with self.connection.pipeline() as pipeline:
            self.cleanup_execution(job, pipeline)
            pipeline.delete(job.key, f"rq:executions:{job.id}")
            pipeline.execute()

    def _run_child(self, job: Any, work: Work, folder: Path) -> kernel.Exit | None:
        """Fork a child for the job and wait for its end; None when it has said that the worker may go on."""
        limited = work.kind != "import"  # an import's process has limits of its own
        try:
            child, ended = self._start_child(work, folder)
        except OSError as error:
            logger.error("job %s: no process could be started for it: %s", work.name, error)
            self._because = start_refused(error)
            return kernel.Exit(None)
        with suppress(OSError):
            os.setpgid(child, child)  # the child does so too: whoever is first, before anybody kills its group
        self._horse_pid = child
        while (exit_ := kernel.wait_for_exit(child, ended, _MONITOR_S)) is None:
            if self._must_end(work, child, folder, limited):
                kernel.kill_group(child)
            self._if_possible(f"a sign of life of job {work.name}", lambda: self.maintain_heartbeats(job))
            self._finishing.is_free()
        self._horse_pid = 0
        if exit_ == "spoken":
            self._let_finish(work, child, ended, folder)
            return None
        os.close(ended)
        return exit_

    def _start_child(self, work: Work, folder: Path) -> tuple[int, int]:
        """Make the job's folder and its process: the process id, and a socket that says when it has ended. Raises
        OSError."""
        self._scratch.make(folder)
        words = json.dumps([work.kind, work.argument, work.attempt, str(folder)]).encode()
        if work.kind == "import" and self._next_import is not None:
            (child, ended), self._next_import = self._next_import, None
            with suppress(BrokenPipeError):
                os.write(ended, words)
                return child, ended
            os.close(ended)  # it has died while it waited
            os.waitpid(child, 0)
        child, ended = self._forked()
        os.write(ended, words)
        return child, ended

    def _forked(self, prepare: Callable[[], object] = lambda: None) -> tuple[int, int]:
        """A process that calls ``prepare`` and then does the work that is written to the socket. Raises OSError."""
        ours, its = socket.socketpair()  # the parent's end is copied once there is a child

        def run() -> None:
            self.setup_work_horse_signals()  # type: ignore[no-untyped-call]
            os.setpgrp()
            kernel.prefer_as_oom_victim()
            ours.close()
            pictures.hold(its.fileno())
            prepare()
            kind, argument, attempt, folder = json.loads(its.recv(1 << 16))
            if kind != "import":
                keep_freed_memory()
                self._job_limits.hold_here()
            self._scratch.use(Path(folder))
            random.seed()
            with self.death_penalty_class(self._limits[kind], JobTimeoutException):
                self._functions[kind](argument, attempt, self.name)

        with ours, its:
            return kernel.forked(run), os.dup(ours.fileno())

    def _let_finish(self, work: Work, child: int, ended: int, folder: Path) -> None:
        """Leave a child to itself whose result is out; the one before it is waited for, so there is one at most."""

        def settle() -> None:
            self._scratch.drop(folder)
            self._write_down(work, lambda: give_up_rest(self._context, work.argument))
            self._sweep()

        until = time.monotonic() + self._context.settings.lost_after_s
        while not self._finishing.is_free(_MONITOR_S):
            self._if_possible("a sign of life", self._report)
        self._finishing.take(ChildAtPictures(child, ended, until, settle))

    def _must_end(self, work: Work, child: int, folder: Path, limited: bool) -> bool:
        """Whether the child is past its time limit or the time that a worker which stops grants it, or,
        ``limited``, over a limit of its memory or disk space."""
        now_s = time.monotonic()
        self._late = now_s - self._started > self._limits[work.kind] + _LATE_GRACE_S
        self._given_back = not self._late and self._give_back_at is not None and now_s >= self._give_back_at
        if self._late or self._given_back:
            return True
        if limited and self._because is None:
            self._because = self._job_limits.exceeded_by(child, folder)
        return self._because is not None

    def _settle(self, work: Work, ended: kernel.Exit, out_of_memory: bool) -> None:
        status = ended.status
        crashed = bool(status) and os.waitstatus_to_exitcode(status or 0) != kernel.RAISED  # by no exception of ours
        end = ChildExit(
            signal=os.WTERMSIG(status) if status is not None and os.WIFSIGNALED(status) else None,
            late=self._late or time.monotonic() - self._started >= self._limits[work.kind],
            out_of_memory=out_of_memory,
            given_back=self._given_back,
            because=self._because,
            crashed_near_limit=work.kind == "registration" and crashed and self._job_limits.is_near(ended.peak_memory),
            limits=self._job_limits,
        )
        settle = settle_import if work.kind == "import" else settle_registration
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
                logger.error("job %s could not be settled: %s", work.name, error)  # the reaper will

        if self._context.settings.storage_url is None:
            write_down()
        elif not kernel.in_child(write_down):  # a client of an object store does not survive the forks to come
            logger.error("job %s could not be settled: the process for it died", work.name)
