"""The worker's spare time: fields that nobody has drawn yet, one at a time on a machine.

A drawing begins only when no work waits, and runs beside the jobs that come later, in a process of lower priority.
It ends with its worker; what it had not finished is begun anew by any worker.
"""

from __future__ import annotations

import fcntl
import logging
import os
import random
import resource
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import groupby

from redis import Redis
from redis.exceptions import RedisError

from regnf_state.ownership import owner_of
from regnf_state.redis.jobs import RedisRecordStore
from regnf_state.settings import Settings
from regnf_worker import kernel
from regnf_worker.job_limits import JobLimits

Draw = Callable[[str], None]
"""(field's reference); runs in a process of its own."""
_LOCK = ".drawing.lock"
_NICENESS = 3
"""Beyond that of a job: where both want a core, the drawing has a third of it. Somebody may wait for the picture."""
_PROCESSOR_S = 60
_LONGEST_S = 900.0
"""By the clock: a busy machine leaves little to a drawing."""
_PAUSE_S = 30.0
"""After a drawing that did not end well: the storage may be away."""
logger = logging.getLogger(__name__)


class FieldDrawer:
    """Draws for one worker. No method raises RedisError or OSError: what fails is tried another time."""

    def __init__(self, redis: Redis, settings: Settings, draw: Draw) -> None:
        self._records = RedisRecordStore(redis)  # without the journal: its storage does not survive the worker's forks
        self._lock = settings.scratch_dir / _LOCK
        self._limits = JobLimits.of(settings)
        self._niceness = min(_NICENESS, settings.job_niceness)
        self._draw = draw
        self._child = 0
        self._until = 0.0
        self._not_before = 0.0

    def go_on(self) -> bool:
        """Begin to draw a field if one waits for it and none is drawn on this machine. Whether this worker draws one.

        Call it whenever there is nothing else to do, every second or so while it draws.
        """
        try:
            if not self._is_drawing() and time.monotonic() >= self._not_before:
                self._begin()
        except (RedisError, OSError) as error:
            logger.warning("no field is drawn now: %s", error)
            self._not_before = time.monotonic() + _PAUSE_S
        return bool(self._child)

    def end(self) -> None:
        """The worker ends: so does what it draws."""
        if self._child:
            with suppress(ProcessLookupError):
                os.kill(self._child, signal.SIGKILL)
            self._collect(0)

    def _is_drawing(self) -> bool:
        if self._child and time.monotonic() > self._until:
            self.end()
        elif self._child:
            self._collect(os.WNOHANG)
        return bool(self._child)

    def _collect(self, flags: int) -> None:
        pid, status = os.waitpid(self._child, flags)
        if pid:
            self._child = 0
            if status:
                self._not_before = time.monotonic() + _PAUSE_S

    def _begin(self) -> None:
        with self._lock.open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held for as long as the child has it open
            except BlockingIOError:
                return
            reference = self._next()
            if reference is None:
                return
            self._until = time.monotonic() + _LONGEST_S
            self._child = kernel.forked(lambda: self._run(reference))

    def _next(self) -> str | None:
        """Of one caller at random the field that somebody wanted to see last."""
        undrawn = sorted(self._records.undrawn_fields(), key=owner_of)  # stable
        lines = [next(fields) for _, fields in groupby(undrawn, owner_of)]
        return random.choice(lines) if lines else None  # noqa: S311 -- for fairness, not for secrecy

    def _run(self, reference: str) -> None:
        """What the child does."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        kernel.prefer_as_oom_victim()
        kernel.give_way(self._niceness)
        self._limits.hold_here()
        resource.setrlimit(resource.RLIMIT_CPU, (_PROCESSOR_S, _PROCESSOR_S + 1))
        self._draw(reference)
