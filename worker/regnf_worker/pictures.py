"""What follows a published result: its pictures and clouds are made and listed, or said to be missing (ADR 18).

The job is successful by then, and nothing of this changes that: whatever goes wrong here costs pictures alone. A job's
process tells its worker once its result is out (``let_worker_go``); what it still does, the worker lets it do beside
the next job (``Finishing``). If the process dies, somebody else says that the files are missing (``give_up_rest``).
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from regnf_state.blobs.base import BlobStore
from regnf_state.manifest import Artifact, Manifest, Rest, read_manifest, rest_key
from regnf_state.records import JobRecord
from regnf_worker import kernel
from regnf_worker.artifacts import discard, store_artifacts
from regnf_worker.engine import Made
from regnf_worker.job_limits import are_files_away
from regnf_worker.models import Context

_DEATH_S = 10.0
"""A killed process is gone within this time."""
_NICENESS = 10
"""Beyond that of a job that has no result yet."""
_writing: list[int] = []
"""The writing end of the pipe to the worker, if this process is a job's. Closed, the process has ended."""
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Published:
    """A result that counts; of this process's own making also what it has yet to write, and into which folder."""

    manifest: Manifest
    made: Made | None = None
    folder: Path | None = None


def hold(writing: int) -> None:
    """This process is a job's; its worker reads the other end."""
    _writing.append(writing)


def let_worker_go() -> None:
    """Tell the worker that it need not wait for this process, where it is a job's. In tests it is none."""
    for pipe in _writing:
        os.write(pipe, b".")
        kernel.give_way(_NICENESS)


def finish_result(context: Context, record: JobRecord, done: Published) -> None:
    """Make what is still to come of a result; of another process's, which is gone, say that it is missing.

    A job that was deleted meanwhile keeps nothing of it. Raises StorageUnavailableError and OSError, when a volume is
    away, with nothing said.
    """
    artifacts = _made(context, done.manifest, done.made, done.folder) if done.made and done.folder else ()
    if not publish_rest(context.blobs, record.id, Rest(artifacts) if artifacts else Rest((), done.manifest.pending)):
        for one in artifacts:
            context.blobs.delete(done.manifest.key(one.name))
    now = context.records.get_job(record.id)
    if now is None:
        context.blobs.delete_prefix(f"jobs/{record.id}")
    elif now.created != record.created:
        discard(context.blobs, record.id, done.manifest.attempt)


def _made(context: Context, manifest: Manifest, made: Made, folder: Path) -> tuple[Artifact, ...]:
    try:
        return store_artifacts(context.blobs, manifest.job_id, manifest.attempt, folder, made.finish())
    except Exception as error:
        if are_files_away(error):
            raise
        logger.exception("job %s: its pictures are missing", manifest.job_id)
        return ()


def give_up_rest(context: Context, job_id: str) -> None:
    """Say that what is still to come of a job's result is missing: its process is gone. Nothing if there is none."""
    manifest = read_manifest(context.blobs, job_id)
    if manifest is not None and manifest.pending and context.records.get_job(job_id) is not None:
        logger.warning("job %s: its pictures are missing, because their process died", job_id)
        publish_rest(context.blobs, job_id, Rest((), manifest.pending))


def publish_rest(blobs: BlobStore, job_id: str, rest: Rest) -> bool:
    """Say what has become of the files that were to come. False when that is said already: it is said once."""
    return blobs.put_if_absent(rest_key(job_id), rest.to_json())


class ChildAtPictures(NamedTuple):
    """A job's process whose result is out. ended: the reading end of its pipe · until: when it has had its time, by the
    monotonic clock · on_end: called once it is gone."""

    pid: int
    ended: int
    until: float
    on_end: Callable[[], None]


class Finishing:
    """The worker's view: one such process at most."""

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
            kernel.kill_group(child.pid)
        if not isinstance(kernel.wait_for_exit(child.pid, child.ended, seconds), kernel.Exit):
            return False
        self._child = None
        os.close(child.ended)
        child.on_end()
        return True

    def end(self, grace_s: float) -> None:
        """The worker stops: what is not made within its grace is missing."""
        if not self.is_free(grace_s) and self._child is not None:
            kernel.kill_group(self._child.pid)
            self.is_free(_DEATH_S)
