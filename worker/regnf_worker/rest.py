"""What follows a published result: its pictures and clouds are made and listed, or said to be missing.

The job is successful by then, and nothing of this changes that: whatever goes wrong here costs pictures alone.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from regnf_state.manifest import Artifact, Manifest, Rest, read_manifest
from regnf_state.records import JobRecord
from regnf_worker.artifacts import discard, publish_rest, store_artifacts
from regnf_worker.context import Context
from regnf_worker.engine import Made
from regnf_worker.problems import are_files_away

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Published:
    """A result that counts; of this process's own making also what it has yet to write, and into which folder."""

    manifest: Manifest
    made: Made | None = None
    folder: Path | None = None


def finish_result(context: Context, record: JobRecord, done: Published) -> None:
    """Make what is still to come of a result; of another process's, which is gone, say that it is missing.

    A job that was deleted meanwhile keeps nothing of it. Raises StorageUnavailableError and OSError, when a volume is
    away, with nothing said.
    """
    artifacts = _made(context, done.manifest, done.made, done.folder) if done.made and done.folder else ()
    rest = Rest(artifacts) if artifacts else Rest(missing=done.manifest.pending)
    if not publish_rest(context.blobs, record.id, rest):
        for one in artifacts:
            context.blobs.delete(done.manifest.key(one.name))
    now = context.records.get_job(record.id)
    if now is None:
        context.blobs.delete_prefix(f"jobs/{record.id}")
    elif now.created != record.created:
        discard(context.blobs, record.id, done.manifest.attempt)


def give_up_rest(context: Context, job_id: str) -> None:
    """Say that what is still to come of a job's result is missing: its process is gone. Nothing if there is none."""
    manifest = read_manifest(context.blobs, job_id)
    if manifest is not None and manifest.pending and context.records.get_job(job_id) is not None:
        logger.warning("job %s: its pictures are missing, their process is gone", job_id)
        publish_rest(context.blobs, job_id, Rest((), manifest.pending))


def _made(context: Context, manifest: Manifest, made: Made, folder: Path) -> tuple[Artifact, ...]:
    """The files, stored; none of them when one cannot be made."""
    try:
        names = made.finish()
        return store_artifacts(context.blobs, manifest.job_id, manifest.attempt, folder, names)
    except Exception as error:
        if are_files_away(error):
            raise
        logger.exception("job %s: its pictures are missing", manifest.job_id)
        return ()
