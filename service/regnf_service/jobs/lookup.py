"""Finding a job by its id, and what it has found."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.manifest import Manifest, read_manifest, read_result
from regnf_state.problems import whole_problem
from regnf_state.records import ACTIVE, JobRecord, UnreadableRecordError

_JOB_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")


def find_job(services: Services, job_id: str, caller: str) -> JobRecord:
    """The caller's own job. Raises Problem JOB_NOT_FOUND, JOB_EXPIRED, UnreadableRecordError."""
    if not _JOB_ID.fullmatch(job_id):
        raise Problem("JOB_NOT_FOUND")
    try:
        record = services.records.get_job(job_id)
    except UnreadableRecordError as error:
        if services.records.owns(caller, job_id):
            raise
        raise Problem("JOB_NOT_FOUND") from error
    if record is None or record.owner != caller:
        raise Problem("JOB_EXPIRED" if services.records.job_expired(job_id, caller) else "JOB_NOT_FOUND")
    return record


def manifest_of(services: Services, record: JobRecord) -> Manifest:
    """The manifest of a successful job. Raises Problem JOB_NOT_READY, JOB_DISMISSED, JOB_FAILED, JOB_EXPIRED."""
    _require_successful(record)
    manifest = read_manifest(services.blobs, record.id)
    if manifest is None:
        raise Problem("JOB_EXPIRED")
    return _without_overdue(services, record, manifest) if manifest.pending else manifest


def _without_overdue(services: Services, record: JobRecord, manifest: Manifest) -> Manifest:
    """What is still to come of a result long after its job has ended is missing: its worker has died with it."""
    waited_s = services.records.now() - (record.finished or record.updated)
    if waited_s < services.settings.lost_after_s:
        return manifest
    return replace(manifest, pending=(), missing=manifest.pending)


def result_of(services: Services, manifest: Manifest) -> dict[str, Any]:
    """The result document. Raises Problem JOB_EXPIRED, UnreadableRecordError."""
    try:
        return read_result(services.blobs, manifest)
    except FileNotFoundError as error:
        raise Problem("JOB_EXPIRED") from error


def _require_successful(record: JobRecord) -> None:
    """Raises Problem JOB_NOT_READY, JOB_DISMISSED, JOB_FAILED with what ended the job.

    A failed job is 409 whatever ended it: this request met no error of the server, and polling it must raise no alarm.
    """
    if record.status in ACTIVE:
        raise Problem("JOB_NOT_READY", headers={"Retry-After": "1"})
    if record.status == "dismissed":
        raise Problem("JOB_DISMISSED")
    if record.status == "failed":
        error = whole_problem(record.error or {})
        raise Problem("JOB_FAILED", f"{error['reason']}: {error['detail']}", extra={"error": error})
