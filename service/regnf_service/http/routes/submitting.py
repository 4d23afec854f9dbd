"""What the routes that start jobs have in common: how they are asked, and the answer with the job."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Header, Query
from starlette.responses import JSONResponse

from regnf_service.concurrency import in_thread
from regnf_service.http.routes.documentation import JOB_LINKS, JSON, header
from regnf_service.http.routes.jobs import job_answer
from regnf_service.http.schemas.jobs import JobDocument
from regnf_service.http.schemas.references import reference
from regnf_service.http.schemas.registrations import DryRunDocument
from regnf_service.http.waiting import wait_for
from regnf_service.jobs.submit import future_job_id, submit
from regnf_service.services import Services
from regnf_state.job_request import JobRequest
from regnf_state.records import ACTIVE, FINISHED

_PREFERENCE = re.compile(r"\s*wait\s*=\s*\"?(\d{1,6})\"?\s*", re.IGNORECASE)
_MAX_WAIT_S = 30
DryRunQuery = Annotated[bool, Query(description="Check everything, start nothing.")]
PreferHeader = Annotated[str | None, Header(description="`wait=N`: hold the answer until the job has finished.")]
IdempotencyKeyHeader = Annotated[
    str | None,
    Header(
        description="Up to 255 printable ASCII characters, kept for 24 hours: refused with another request.",
        json_schema_extra={"pattern": "^[!-~]([ -~]{0,253}[!-~])?$"},
    ),
]
JOB_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The job has finished (`Prefer: wait`, or an identical one had), or the dry run passed.",
        "content": {JSON: {"schema": {"anyOf": [reference(JobDocument), reference(DryRunDocument)]}}},
        "links": JOB_LINKS,
    },
    202: {
        "description": "Accepted.",
        "headers": {"Location": header("The job."), "Retry-After": header("Seconds until a look is worth it.")},
        "links": JOB_LINKS,
    },
}
JOB_REFUSALS = (
    "INVALID_QUERY",
    "INVALID_IDEMPOTENCY_KEY",
    "INVALID_WEBHOOK",
    "WEBHOOK_NOT_ALLOWED",
    "IDEMPOTENCY_KEY_REUSED",
    "QUEUE_FULL",
    "QUOTA_ACTIVE_JOBS",
    "QUOTA_WEBHOOKS",
)


@dataclass(frozen=True)
class Asking:
    """How a job is asked for, beside what it is to do."""

    dry_run: bool
    prefer: str | None
    idempotency_key: str | None


def preferred_wait(prefer: str | None) -> int | None:
    """The seconds of `Prefer: wait=N` (RFC 7240), at most thirty; what is malformed is ignored, as the RFC has it."""
    for preference in (prefer or "").split(","):
        match = _PREFERENCE.fullmatch(preference)
        if match:
            return min(int(match.group(1)), _MAX_WAIT_S)
    return None


async def answer(services: Services, caller: str, prefix: str, asked: JobRequest, asking: Asking) -> JSONResponse:
    """The answer to a request that was checked: the job, or what a dry run tells."""
    if asking.dry_run:
        job_id = await in_thread(future_job_id, services, caller, asked)
        return JSONResponse({"valid": True, "id": job_id, "request": asked.values()})
    record = await in_thread(submit, services, caller, asked, asking.idempotency_key)
    wait = preferred_wait(asking.prefer)
    if wait and record.status in ACTIVE:
        record = await wait_for(
            lambda: services.records.get_job(record.id) or record,
            lambda found: found.status in FINISHED,
            wait,
            services,
            caller,
        )
    response = await job_answer(services, record, prefix, 200 if record.status in FINISHED else 202)
    response.headers["Location"] = f"{prefix}/jobs/{record.id}"
    if wait is not None:
        response.headers["Preference-Applied"] = f"wait={wait}"
    return response
