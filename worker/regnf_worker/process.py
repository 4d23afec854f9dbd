"""The worker process: takes ids from the queue, forks a child for each, limits it, and settles the job's record.

Only two functions ever run, children end with the worker, time limits also stop native code, a Redis that is full or
away does not end the worker, and after a child's death no record says that the job still runs. The worker never runs a
torch operation itself: the forked children of a process that has hang.

There are three kinds of calls of Redis. What must succeed before the worker continues, such as its sign of life, is
repeated until Redis accepts it: a worker that cannot write takes nothing. What only tidies up is skipped. What is
written while a child runs is never repeated: the child has time limits, which the worker must keep.
"""

from __future__ import annotations

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
from typing import TypeVar
from uuid import uuid4

from redis.exceptions import RedisError

from regnf_core.importing.gate.child import LONGEST
from regnf_state.queue import Kind, Work
from regnf_state.records import UnreadableRecordError
from regnf_state.redis.client import WORKER_RETRIES, connect, redis_address
from regnf_state.redis.queue import JobQueue
from regnf_worker import jobs, kernel, pictures
from regnf_worker.job_limits import JobLimits, start_refused
from regnf_worker.jobs import Draw, FieldDrawer
from regnf_worker.kernel import Scratch
from regnf_worker.models import Context, is_unmodeled_entry
from regnf_worker.pictures import ChildAtPictures, Finishing, give_up_rest
from regnf_worker.settle import ChildExit, settle_import, settle_registration
from regnf_worker.taking import StopRequestedError, Taking, retry_until_available

Function = Callable[[str, int, str], None]
"""(job's id or field's reference, attempt, worker)."""
FUNCTIONS: Mapping[Kind, Function] = {"import": jobs.run_import, "registration": jobs.run_registration}
"""Everything that a worker runs, whatever the queue says."""
_LATE_GRACE_S = 10.0
"""After its time limit a job has this long to write down that it was too slow; then it is killed."""
_IMPORT_MARGIN_S = 30
_MONITOR_S = 1.0
"""How often the worker checks the child that it runs, and whether it shall stop."""
_Value = TypeVar("_Value")
logger = logging.getLogger(__name__)


class RegnfWorker:
    """One worker of the service."""

    def __init__(
        self,
        context: Context,
        scratch: Scratch,
        functions: Mapping[Kind, Function] = FUNCTIONS,
        draw: Draw = jobs.run_drawing,
    ) -> None:
        redis = connect(redis_address(context.settings), retries=WORKER_RETRIES)
        self.name = f"{socket.gethostname()}:{uuid4().hex}"
        self._context = context
        self._scratch = scratch
        self._functions = functions
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
        self._started = 0.0
        self._late = False
        self._give_back_at: float | None = None
        self._given_back = False

    @property
    def stopping(self) -> bool:
        """Whether it was told to stop."""
        return self._give_back_at is not None

    def serve(self) -> None:
        """Work until told to stop, be it while starting."""
        signal.signal(signal.SIGINT, self._stop)
        signal.signal(signal.SIGTERM, self._stop)
        try:
            while not self.stopping:
                work = self.next_work()
                if work is not None:
                    self.execute(work)
        except StopRequestedError:
            pass
        finally:
            self._if_possible("signing off", lambda: self._queue.sign_off(self.name))
            self._drawer.end()
            self._finishing.end(self._context.settings.shutdown_grace_s)

    def _stop(self, signum: int, frame: object) -> None:  # noqa: ARG002 -- what handlers are given
        """A running job has ``shutdown_grace_s`` to end, then goes back to the queue. Told again: at once."""
        grace_s = 0.0 if self.stopping else self._context.settings.shutdown_grace_s
        self._give_back_at = time.monotonic() + grace_s

    def _until_available(self, what: str, do: Callable[[], _Value]) -> _Value:
        return retry_until_available(what, do, stopped=lambda: self.stopping)

    def _if_possible(self, what: str, do: Callable[[], object]) -> None:
        try:
            do()
        except RedisError as error:
            logger.warning("%s is skipped: %s", what, error)

    def next_work(self) -> Work | None:
        """What is to be done now, waited for for a second."""
        self._until_available("a sign of life", lambda: self._queue.report(self.name))
        taken = self._until_available("taking a job", partial(self._queue.pop, 0))
        if taken is None:
            self._drawer.go_on()
            self._finishing.is_free()
            self._scratch.drop_left()
            taken = self._until_available("waiting for a job", partial(self._queue.pop, 1))
        if taken is None:
            return None
        return self._until_available("looking at what was taken", partial(self._taking.accept, taken))

    # one job

    def execute(self, work: Work) -> None:
        """Run one job in a child, limit it, and settle its record. A job that is taken and not begun is in no queue
        any more: the reaper puts it back.
        """
        logger.info("%s: %s", work.kind, work.name)
        self._started = time.monotonic()
        self._late = self._given_back = False
        self._because = None
        oom_kills = kernel.oom_kills()
        self._until_available(f"taking up job {work.name}", lambda: self._queue.begin(work.name, self.name))
        was_entry = self._is_unmodeled(work, otherwise=True)
        folder = self._scratch.of_job()
        end = self._run_child(work, folder)
        if end is not None:
            self._scratch.drop(folder)
        self._if_possible(f"the queue's forgetting {work.name}", lambda: self._queue.end(work.name))
        if end is not None:
            self._settle(work, end, kernel.oom_kills() > oom_kills)
        if work.kind == "import":
            self._if_possible("queueing what waited", lambda: self._queue.release(work.argument))
        if not was_entry and self._is_unmodeled(work, otherwise=False):
            # became a library's entry too late for its import to see it, and work that runs is not queued twice
            self._if_possible("modeling an entry", lambda: self._queue.enqueue_import(work.argument, work.attempt))

    def _is_unmodeled(self, work: Work, otherwise: bool) -> bool:
        """Whether an import's field is an entry without a model; ``otherwise`` where that cannot be told now."""
        try:
            return work.kind == "import" and is_unmodeled_entry(self._taking.records, work.argument, work.attempt)
        except (RedisError, UnreadableRecordError) as error:
            logger.warning("whether %s is an entry without a model is not known: %s", work.argument, error)
            return otherwise

    def _run_child(self, work: Work, folder: Path) -> kernel.Exit | None:
        """Fork a child for the job and wait for its end; None when it has said that the worker may go on."""
        limited = work.kind != "import"  # an import's process has limits of its own
        try:
            child, ended = self._start_child(work, folder, limited)
        except OSError as error:
            logger.error("job %s: no process could be made for it: %s", work.name, error)
            self._because = start_refused(error)
            return kernel.Exit(None)
        with suppress(OSError):
            os.setpgid(child, child)  # the child does so too: whoever is first, before anybody kills its group
        while (exit_ := kernel.wait_for_exit(child, ended, _MONITOR_S)) is None:
            if self._must_end(work, child, folder, limited):
                kernel.kill_group(child)
            self._if_possible("a sign of life", lambda: self._queue.report(self.name))
            self._finishing.is_free()
        if exit_ == "spoken":
            self._let_finish(work, child, ended, folder)
            return None
        os.close(ended)
        return exit_

    def _start_child(self, work: Work, folder: Path, limited: bool) -> tuple[int, int]:
        """Make the job's folder and its process: the process id, and a pipe that says when it has ended. Raises
        OSError."""
        self._scratch.make(folder)
        ended, held_by_child = os.pipe()

        def run() -> None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            os.setpgrp()
            kernel.prefer_as_oom_victim()
            os.close(ended)
            pictures.hold(held_by_child)
            if limited:
                self._job_limits.hold_here()
            self._scratch.use(folder)
            random.seed()
            with kernel.time_limit(self._limits[work.kind]):
                self._functions[work.kind](work.argument, work.attempt, self.name)

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
        while not self._finishing.is_free(_MONITOR_S):
            self._if_possible("a sign of life", lambda: self._queue.report(self.name))
        self._finishing.take(ChildAtPictures(child, ended, until, settle))

    def _must_end(self, work: Work, child: int, folder: Path, limited: bool) -> bool:
        """Whether the child was cancelled, is past its time limit or the time that a worker which stops grants it, or,
        ``limited``, over a limit of its memory or disk space."""
        now_s = time.monotonic()
        self._late = now_s - self._started > self._limits[work.kind] + _LATE_GRACE_S
        self._given_back = not self._late and self._give_back_at is not None and now_s >= self._give_back_at
        if self._late or self._given_back:
            return True
        if limited and self._because is None:
            self._because = self._job_limits.exceeded_by(child, folder)
        if self._because is not None:
            return True
        try:
            return not self._queue.goes_on(work.name, self.name)
        except RedisError as error:
            logger.warning("a sign of life of job %s is skipped: %s", work.name, error)
            return False

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
            logger.error("job %s could not be settled: the process that should have has died", work.name)
