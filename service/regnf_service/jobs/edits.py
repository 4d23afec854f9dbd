"""The edits of a rendering: what names a registration job becomes that job's object, with the transform it found."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.manifest import Manifest, read_manifest, read_result, without_drawings
from regnf_state.ownership import reference_of
from regnf_state.reasons import whole_problem
from regnf_state.records import ACTIVE, JobRecord, UnreadableRecordError
from regnf_state.registration_request import REGISTRATION

# Finding a job by its id, and what it has found.

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
    return without_drawings(replace(manifest, pending=(), missing=manifest.pending))


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


def plain_edits(
    services: Services, caller: str, scene: str, edits: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """The edits, plain values, as the engine takes them: with object and transform instead of a ``job``.

    Raises Problem, pointing at the edit: JOB_NOT_FOUND, JOB_EXPIRED, JOB_NOT_READY, JOB_DISMISSED, JOB_FAILED,
    EDIT_INVALID.
    """
    found: dict[str, dict[str, Any]] = {}
    plain = []
    for number, edit in enumerate(edits):
        values = {member: value for member, value in edit.items() if member != "job"}
        if (job_id := edit.get("job")) is not None:
            if job_id not in found:
                found[job_id] = _named(services, caller, scene, job_id, f"/edits/{number}/job")
            values = found[job_id] | values
        plain.append(values)
    return plain


def _named(services: Services, caller: str, scene: str, job_id: str, pointer: str) -> dict[str, Any]:
    try:
        record = find_job(services, job_id, caller)
        _require_of_scene(record, reference_of(caller, scene))
        result = result_of(services, manifest_of(services, record))
        if result.get("verdict") == "rejected":
            hint = "To use it anyway, give `object` and `T_object_scene` instead of `job`."
            raise Problem("EDIT_INVALID", "The verdict of the registration is `rejected`.", hint=hint)
        return _members(record, result)
    except Problem as problem:
        fault = {"pointer": pointer, "detail": problem.detail}
        raise Problem(
            problem.reason,
            problem.detail,
            errors=[fault],
            headers=problem.headers,
            hint=problem.hint,
            extra=problem.extra,
        ) from problem


def _require_of_scene(record: JobRecord, scene: str) -> None:
    if record.kind != REGISTRATION:
        raise Problem("EDIT_INVALID", "The job is a rendering. Give the registration that found the object.")
    if record.request.get("scene") != scene:
        hint = "If both scenes have the same frame, give `object` and `T_object_scene` of its result instead of `job`."
        raise Problem("EDIT_INVALID", "The job is a registration in another scene.", hint=hint)


def _members(record: JobRecord, result: Mapping[str, Any]) -> dict[str, Any]:
    metrics = result.get("metrics") or {}
    lengths = [metrics.get("residual_rms"), metrics.get("object_diameter")]
    members = {
        "object": result.get("object") or record.inputs.get("object"),
        "T_object_scene": result["T_object_scene"]["matrix"],
    }
    if all(isinstance(one, int | float) and math.isfinite(one) for one in lengths):
        members["residual"] = math.prod(lengths)
    return members
