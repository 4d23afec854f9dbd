"""The edits of a rendering: what names a registration job becomes that job's object, with the transform it found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from regnf_service.jobs.lookup import find_job, manifest_of, result_of
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.job_request import REGISTRATION
from regnf_state.ownership import reference_of
from regnf_state.records import JobRecord


def plain_edits(
    services: Services, caller: str, scene: str, edits: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """The edits, plain values, as the engine takes them: with object and transform instead of a ``job``.

    Raises Problem, pointing at the edit: JOB_NOT_FOUND, JOB_EXPIRED, JOB_NOT_READY, JOB_DISMISSED, JOB_FAILED,
    EDIT_INVALID, EDIT_POSE_REJECTED.
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
    """What a registration found, as the members of an edit."""
    try:
        record = find_job(services, job_id, caller)
        _require_of_scene(record, reference_of(caller, scene))
        result = result_of(services, manifest_of(services, record))
        if result.get("verdict") == "rejected":
            raise Problem("EDIT_POSE_REJECTED")
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
        raise Problem("EDIT_INVALID", "The job is a rendering. Name the registration that found the object.")
    if record.request.get("scene") != scene:
        hint = "If both scenes have one frame, give `object` and `T_object_scene` of its result instead of `job`."
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
