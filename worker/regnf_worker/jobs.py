"""The functions that workers run. Each runs in a process of its own, forked for one job.

The arguments of jobs and imports: the worker's settings, the job's id or the field's reference, which attempt it is,
and the worker that runs it.
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
from pathlib import Path
from typing import Any

from redis import Redis
from redis.exceptions import RedisError

from regnf_core.errors import RegnfError
from regnf_core.field_notes import FieldViews
from regnf_state.ownership import owner_of
from regnf_state.pieces import delete_views, view_key
from regnf_state.records import FieldRecord, StaleAttemptError
from regnf_state.redis.jobs import RecordStore
from regnf_state.settings import Settings
from regnf_worker import kernel
from regnf_worker.job_limits import JobLimits
from regnf_worker.models import Context


def run_registration(settings: Settings, job_id: str, attempt: int, worker: str) -> None:
    """Run the attempt at a job that the queue handed out: its record says what it is, a registration or a rendering."""
    from regnf_worker.attempt import run_attempt
    from regnf_worker.engine import Engine

    context = Context.from_settings(settings, existing=True)
    run_attempt(context, job_id, attempt, worker, lambda: Engine.on(settings.device, settings.workers))


def run_import(settings: Settings, sha256: str, attempt: int, worker: str) -> None:
    """Run the attempt at an import that the queue handed out, and model the object if it is a library's.

    For a field that became a library's entry after its import, only the model is left to be made.
    """
    from regnf_core.importing.gate.gate import ImportLimits
    from regnf_worker.engine import Engine, core_importer
    from regnf_worker.imports import run_import_attempt
    from regnf_worker.job_limits import JobLimits
    from regnf_worker.models import is_unmodeled_entry, model_entry

    limits = ImportLimits(
        wall_s=settings.import_timeout_s, work_s=settings.import_work_s, memory_bytes=settings.import_memory_bytes
    )
    context = Context.from_settings(settings, existing=True)
    run_import_attempt(context, sha256, attempt, worker, core_importer(limits))
    if is_unmodeled_entry(context.records, sha256, attempt):
        JobLimits.of(settings).hold_here()
        model_entry(context, sha256, Engine.on(settings.device, settings.workers))


def run_drawing(reference: str) -> None:
    """Draw a field that is ready."""
    from regnf_core.viewing.field_views import field_views

    draw_field(Context.from_settings(Settings(), existing=True), reference, field_views)


# Making the mesh and the picture of a field that is ready, in a process of its own. Nothing waits for it.

_MOST_DRAWINGS = 3
"""A field whose drawing has died with its process as often has nothing to look at."""
logger = logging.getLogger(__name__)


def draw_field(context: Context, reference: str, draw: Callable[[Path], FieldViews]) -> None:
    """Make what people look at of a field, and note in its record that it is there, or cannot be made.

    The record says first that it was begun: a drawing that kills its process is not begun for ever. Does nothing to a
    field that has moved on, and leaves nothing of one that was deleted meanwhile. Raises RedisError, OSError.
    """
    field = context.records.get_field(reference)
    if field is None or field.state != "ready" or field.views != "pending":
        return
    if field.drawings >= _MOST_DRAWINGS:
        logger.warning("field %s is not drawn: drawing was started %d times", reference, field.drawings)
        _note(context, field, views="none")
        return
    if not _note(context, field, drawings=field.drawings + 1):
        return
    try:
        with context.blobs.local_copy(view_key(reference, "field.safetensors")) as path:
            made = draw(path)
    except RegnfError as error:
        logger.warning("field %s is not drawn: %s", reference, error)
        _note(context, field, views="none")
        return
    except FileNotFoundError:
        now = context.records.get_field(reference)
        if now is not None and now.attempt == field.attempt:
            raise
        return  # it was deleted, or is imported again, while it was opened
    _keep(context, field, made)


def _keep(context: Context, field: FieldRecord, made: FieldViews) -> None:
    kept = made.files()
    delete_views(context.blobs, field.sha256)  # those of what the field was before
    for name, data in kept.items():
        context.blobs.put(view_key(field.sha256, name), data)
    if _note(context, field, views="ready" if kept else "none"):
        return
    now = context.records.get_field(field.sha256)
    if now is None:
        context.blobs.delete_prefix(f"fields/{field.sha256}")
    elif now.views != "ready":
        delete_views(context.blobs, field.sha256)


def _note(context: Context, field: FieldRecord, **changes: Any) -> bool:
    """Write it down; False when the field was deleted, or is imported again."""
    with suppress(StaleAttemptError):
        context.records.update_field(field.sha256, attempt=field.attempt, **changes)
        return True
    return False


# The worker's spare time: fields that nobody has drawn yet, one at a time on a machine.
#
# A drawing begins only when no work waits, and runs beside the jobs that come later, in a process of lower priority.
# It ends with its worker; what it had not finished is begun again by any worker.

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


class FieldDrawer:
    """Draws for one worker. No method raises RedisError or OSError: what fails is tried another time."""

    def __init__(self, redis: Redis, settings: Settings, draw: Draw) -> None:
        self._records = RecordStore(redis)  # without the journal: its storage does not survive the worker's forks
        self._lock = settings.scratch_dir / _LOCK
        self._limits = JobLimits.of(settings)
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
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        kernel.prefer_as_oom_victim()
        kernel.give_way(_NICENESS)
        self._limits.hold_here()
        resource.setrlimit(resource.RLIMIT_CPU, (_PROCESSOR_S, _PROCESSOR_S + 1))
        self._draw(reference)
