"""Finding a job by the id in a path."""

from __future__ import annotations

import re

from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.records import JobRecord, UnreadableRecordError

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
