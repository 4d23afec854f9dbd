"""How the worker settles a record whose process ended without writing its outcome."""

from __future__ import annotations

import logging
import signal
from dataclasses import dataclass
from typing import Any

from regnf_state.manifest import read_manifest
from regnf_state.reasons import problem_document
from regnf_state.records import ACTIVE, JobRecord, StaleAttemptError
from regnf_worker.artifacts import discard, keep_edited_field, told_by_result
from regnf_worker.imports import claim_import, reject
from regnf_worker.job_limits import OVER_LIMIT, JobLimits, over_limit, timeout
from regnf_worker.models import Context
from regnf_worker.pictures import give_up_rest

logger = logging.getLogger(__name__)
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM)
"""Signals from outside. Others, for example of a segmentation fault, would come again in the next attempt."""
_DETAILS = {
    "WORKER_LOST": "The process that did the work was killed. Send the request again.",
    "INTERNAL": "Internal error: the process of the job ended without a report. See the log entries of the job's id.",
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
        logger.warning("job %s attempt %d is run again", job_id, attempt)
        return
    else:
        changes = {"status": "failed", "error": _problem(context, end)}
    context.records.update_job(job_id, attempt, **changes)
    logger.warning("job %s attempt %d: its process died (%s): %s", job_id, attempt, end, changes["status"])


def settle_import(context: Context, sha256: str, attempt: int, worker: str, end: ChildExit) -> None:
    """The same for an import: one that was given back, killed, or ended by itself starts again; others are rejected."""
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
    logger.warning("import %s attempt %d: its process died (%s)", sha256, attempt, end)
    late = timeout("IMPORT_TIMEOUT", context.settings.import_timeout_s)
    reject(context, sha256, attempt, late if end.late else _problem(context, end))


def _problem(context: Context, end: ChildExit) -> dict[str, Any]:
    reason = end.reason()
    if end.late:
        return timeout(reason, context.settings.job_timeout_s)
    if end.limits is not None and reason in OVER_LIMIT and (end.because or not end.out_of_memory):
        return over_limit(reason, end.limits)
    return problem_document(reason, _DETAILS.get(reason))
