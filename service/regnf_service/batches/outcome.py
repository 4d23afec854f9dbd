"""What a batch's results say of a pair that has ended: one line each."""

from __future__ import annotations

from typing import Any

from regnf_core.pair_result import short_result
from regnf_service.jobs.lookup import manifest_of, result_of
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.batch_records import OpenPair, Pair
from regnf_state.problems import problem_document, whole_problem
from regnf_state.records import JobRecord, UnreadableRecordError


def outcome(services: Services, pair: Pair, one: OpenPair, job: JobRecord | None) -> dict[str, Any]:
    """The line of a pair: of its job, which has ended; without one, of its error."""
    told: dict[str, Any] = {"pair": pair.number, "line": pair.line, "key": pair.key, "job": one.job or None}
    if pair.error is not None:
        return told | {"status": "refused", "error": pair.error}
    if one.error is not None:
        return told | {"status": "failed", "error": one.error}
    if job is None:
        return told | {"status": "failed", "error": problem_document("JOB_EXPIRED")}
    try:
        result = result_of(services, manifest_of(services, job))
    except Problem as problem:
        error = whole_problem(job.error) if job.status == "failed" and job.error else problem.document()
        return told | {"status": "failed", "error": error}
    except UnreadableRecordError as error:
        return told | {"status": "failed", "error": problem_document(error.reason)}
    return told | {"status": "successful", **short_result(result)}


def counted_as(line: dict[str, Any]) -> str:
    """Which count of the batch a line belongs to."""
    return str(line["verdict"] if line["status"] == "successful" else line["status"])
