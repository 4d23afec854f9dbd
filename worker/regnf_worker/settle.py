"""How the worker settles a record whose process ended without writing its outcome."""

from __future__ import annotations

import hashlib
import logging
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from regnf_state.blobs.base import BlobStore
from regnf_state.manifest import (
    EDITED_FIELD,
    Artifact,
    Manifest,
    Rest,
    artifact_key,
    manifest_key,
    read_manifest,
    read_result,
    rest_key,
)
from regnf_state.ownership import reference_of
from regnf_state.reasons import problem_document
from regnf_state.records import (
    ACTIVE,
    FieldRecord,
    JobRecord,
    QuotaError,
    StaleAttemptError,
    UnreadableRecordError,
    quota_of,
)
from regnf_state.room import delete_upload, original_key
from regnf_worker.engine import Made
from regnf_worker.imports import claim_import, reject
from regnf_worker.job_limits import OVER_LIMIT, JobLimits, are_files_away, over_limit, timeout
from regnf_worker.models import Context

# An edited scene becomes a field of its owner, as if it had been uploaded: named by its digest, imported as any.
#
# The artifact of the rendering stays as it is. Where the owner has no room for one more field, it is all that there
# is.

_CHUNK_BYTES = 1 << 20


def keep_edited_field(context: Context, owner: str, manifest: Manifest) -> None:
    """Have the edited scene among a published result imported. Does nothing where there is none, or it is a field."""
    artifact = manifest.served().get(EDITED_FIELD)
    if artifact is None:
        return
    reference = reference_of(owner, artifact.sha256)
    try:
        known = context.records.get_field(reference)
        if known is not None and known.state != "rejected":
            return
        with context.blobs.open(manifest.key(EDITED_FIELD)) as source, context.blobs.writer() as writer:
            while chunk := source.read(_CHUNK_BYTES):
                writer.write(chunk)
            writer.commit(original_key(reference))
        _import(context, reference, artifact.bytes)
    except (FileNotFoundError, UnreadableRecordError) as error:
        logger.warning("the edited scene of job %s is no field: %s", manifest.job_id, error)


def _import(context: Context, reference: str, size: int) -> None:
    now = context.records.now()
    field = FieldRecord(reference, "validating", size, now, now)
    try:
        record, _ = context.records.create_field(field, quota_of(context.settings))
    except QuotaError as error:
        delete_upload(context.blobs, field)
        logger.info("the edited scene %s is no field: %s", reference, error.reason)
        return
    if record.state == "validating":
        context.queue.enqueue_import(reference, record.attempt)


# Results into the blob store: files under their attempt, then the manifest, which makes them count.

_VERDICTS = ("registered", "ambiguous", "rejected")


def told_by_result(blobs: BlobStore, manifest: Manifest) -> dict[str, str | None]:
    """What the job's record says of its result: the verdict if it is a known one, and of a search the object found."""
    try:
        result = read_result(blobs, manifest)
    except (FileNotFoundError, UnreadableRecordError):
        return {}
    verdict, found = result.get("verdict"), result.get("object")
    return {
        "verdict": verdict if verdict in _VERDICTS else None,
        "object_found": found if isinstance(found, str) and result.get("candidates") else None,
    }


def store_artifacts(
    blobs: BlobStore, job_id: str, attempt: int, folder: Path, names: Sequence[str]
) -> tuple[Artifact, ...]:
    """Copy files into the store under the attempt. They do not count before the manifest is published."""
    return tuple(_store(blobs, artifact_key(job_id, attempt, name), folder / name) for name in names)


def publish(blobs: BlobStore, manifest: Manifest) -> bool:
    """Make the result count. False when another attempt has published one already: a job has one result, ever."""
    return blobs.put_if_absent(manifest_key(manifest.job_id), manifest.to_json())


def publish_rest(blobs: BlobStore, job_id: str, rest: Rest) -> bool:
    """Say what has become of the files that were to come. False when that is said already: it is said once."""
    return blobs.put_if_absent(rest_key(job_id), rest.to_json())


def discard(blobs: BlobStore, job_id: str, attempt: int) -> None:
    """Delete what an attempt wrote that does not count."""
    blobs.delete_prefix(f"jobs/{job_id}/{attempt}")


def discard_others(blobs: BlobStore, manifest: Manifest) -> None:
    """Delete what other attempts have left behind, now that they can no longer publish it."""
    keep = set(manifest.keys())
    for key in blobs.list(f"jobs/{manifest.job_id}"):
        if key not in keep:
            blobs.delete(key)


def _store(blobs: BlobStore, key: str, path: Path) -> Artifact:
    digest = hashlib.sha256()
    with path.open("rb") as source, blobs.writer() as writer:
        while chunk := source.read(_CHUNK_BYTES):
            digest.update(chunk)
            writer.write(chunk)
        writer.commit(key)
    return Artifact(path.name, path.stat().st_size, digest.hexdigest())


# What follows a published result: its pictures and clouds are made and listed, or said to be missing.
#
# The job is successful by then, and nothing of this changes that: whatever goes wrong here costs pictures alone.


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


logger = logging.getLogger(__name__)
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM)
"""Signals from outside. Others, for example of a segmentation fault, would come again in the next attempt."""
_DETAILS = {
    "WORKER_LOST": "The process that did the work was killed. Send the request again.",
    "INTERNAL": "Internal error: the process of the job ended without a report. The log has more under its id.",
}


@dataclass(frozen=True)
class ChildExit:
    """How a job's process ended: the signal, if any, and what the worker knows about the cause."""

    signal: int | None = None
    late: bool = False
    out_of_memory: bool = False
    given_back: bool = False
    """The worker itself was told to stop and ended its job."""
    because: str | None = None
    """The worker ended it, or could not begin it, for this: OUT_OF_MEMORY, JOB_DISK_LIMIT, STORAGE_FULL,
    STORAGE_UNAVAILABLE."""
    crashed_near_limit: bool = False
    """It ended by itself, not well, after it had used most of the memory that it may: native code that gets no memory
    aborts."""
    limits: JobLimits | None = None
    """Those that held for it."""

    @property
    def worth_another_try(self) -> bool:
        """Usually Redis or storage was away, or somebody killed it; it was neither too slow nor too large."""
        if self.late or self.because not in (None, "STORAGE_UNAVAILABLE") or self.reason() == "OUT_OF_MEMORY":
            return False
        return self.signal is None or (self.signal in _FROM_OUTSIDE and not self.out_of_memory)

    def reason(self) -> str:
        if self.late:
            return "JOB_TIMEOUT"
        if self.because:
            return self.because
        if self.crashed_near_limit and self.signal not in _FROM_OUTSIDE:
            return "OUT_OF_MEMORY"
        if self.out_of_memory and self.signal == signal.SIGKILL:
            return "OUT_OF_MEMORY"
        return "WORKER_LOST" if self.signal is not None else "INTERNAL"


def settle_registration(context: Context, job_id: str, attempt: int, worker: str, end: ChildExit) -> None:
    """Settle the record of a job whose process is gone, so that it no longer says that the job runs.

    With a published result the job is successful; with a request to cancel, dismissed. A worker that stops gives the
    job back to the queue. A process that was killed, or that ended because Redis or storage was away, gets one more
    attempt. In all other cases the job has failed.
    """
    record = context.records.get_job(job_id)
    if record is None or record.attempt != attempt:
        return
    if record.status not in ACTIVE:
        give_up_rest(context, job_id)
        return
    try:
        if record.status == "accepted":  # it died before it could claim its job
            record = context.records.update_job(job_id, attempt, status="running", worker=worker)
        if record.worker != worker:
            return  # handed out twice, and the other one has it
        _settle(context, record, end)
    except StaleAttemptError as error:
        logger.info("job %s attempt %d: another process has settled it: %s", job_id, attempt, error)


def _settle(context: Context, record: JobRecord, end: ChildExit) -> None:
    job_id, attempt = record.id, record.attempt
    manifest = read_manifest(context.blobs, job_id)
    if manifest is not None:
        keep_edited_field(context, record.owner, manifest)
        context.records.update_job(job_id, attempt, status="successful", **told_by_result(context.blobs, manifest))
        give_up_rest(context, job_id)
        return
    discard(context.blobs, job_id, attempt)
    changes: dict[str, Any]
    if record.cancel_requested:
        changes = {"status": "dismissed"}
    elif end.given_back or (end.worth_another_try and record.requeues == 0):
        again = context.records.requeue_job(job_id, attempt, lost=not end.given_back)
        context.queue.enqueue_registration(job_id, again.attempt, again.owner, again.is_of_batch)
        logger.warning("job %s attempt %d is to be run again", job_id, attempt)
        return
    else:
        changes = {"status": "failed", "error": _problem(context, end)}
    context.records.update_job(job_id, attempt, **changes)
    logger.warning("job %s attempt %d: its process is gone (%s): %s", job_id, attempt, end, changes["status"])


def settle_import(context: Context, sha256: str, attempt: int, worker: str, end: ChildExit) -> None:
    """The same for an import: one that was given back, killed, or ended by itself starts anew; others are rejected."""
    field = context.records.get_field(sha256)
    if field is None or field.attempt != attempt or field.state != "validating":
        return
    if not claim_import(context, sha256, attempt, worker):
        return
    if end.given_back or (end.worth_another_try and field.requeues == 0):
        try:
            again = context.records.retry_import(sha256, attempt, lost=not end.given_back)
        except StaleAttemptError:
            return
        context.queue.enqueue_import(sha256, again.attempt)
        return
    logger.warning("import %s attempt %d: its process is gone (%s)", sha256, attempt, end)
    late = timeout("IMPORT_TIMEOUT", context.settings.import_timeout_s)
    reject(context, sha256, attempt, late if end.late else _problem(context, end))


def _problem(context: Context, end: ChildExit) -> dict[str, Any]:
    reason = end.reason()
    if end.late:
        return timeout(reason, context.settings.job_timeout_s)
    if end.limits is not None and reason in OVER_LIMIT and (end.because or not end.out_of_memory):
        return over_limit(reason, end.limits)
    return problem_document(reason, _DETAILS.get(reason))
