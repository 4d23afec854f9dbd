"""What went wrong, as the problem object that a record carries. No traceback and no path ever leaves through here."""

from __future__ import annotations

import errno
from typing import Any
from uuid import uuid4

from rq.timeouts import JobTimeoutException

from regnf_state.blobs.base import StorageFullError
from regnf_state.problems import problem_document
from regnf_worker.job_limits import JobLimits

OVER_LIMIT = {"JOB_MEMORY_LIMIT": "memory", "JOB_DISK_LIMIT": "temporary files"}
"""Reasons of jobs that were over a limit, and of what."""
_LIMIT_OF = {"JOB_MEMORY_LIMIT": "memory", "JOB_DISK_LIMIT": "scratch"}
_GIB = 1 << 30
_OUT_OF_MEMORY_PHRASES = ("can't allocate memory", "out of memory", "cannot allocate memory", "bad_alloc")
_FULL = {errno.ENOSPC, errno.EDQUOT}
_AWAY = {errno.ENOENT, errno.EIO, errno.ENODEV, errno.ENXIO, errno.ENOTCONN, errno.EROFS, errno.ESTALE}


def fault(error: Exception, incident: str, limits: JobLimits | None = None) -> dict[str, Any]:
    """The problem of an exception that is not one of regnf's own refusals; ``incident`` finds it in the log.

    limits: those that hold for this process, if any do.
    """
    if isinstance(error, JobTimeoutException):
        return problem_document("JOB_TIMEOUT")
    if is_out_of_memory(error):
        of_gpu = "cuda" in str(error).lower()
        return problem_document("OUT_OF_MEMORY") if limits is None or of_gpu else over_limit("JOB_MEMORY_LIMIT", limits)
    if limits is not None and isinstance(error, OSError) and error.errno == errno.EFBIG:
        return over_limit("JOB_DISK_LIMIT", limits)
    if isinstance(error, StorageFullError) or (isinstance(error, OSError) and error.errno in _FULL):
        return problem_document("STORAGE_FULL")
    return problem_document("INTERNAL", f"Internal error. The log has it under incident {incident}.", incident=incident)


def over_limit(reason: str, limits: JobLimits) -> dict[str, Any]:
    """The problem of a job that was over one of its limits: JOB_MEMORY_LIMIT or JOB_DISK_LIMIT."""
    what, limit = OVER_LIMIT[reason], getattr(limits, _LIMIT_OF[reason])
    detail = f"The job needed more than the {limit / _GIB:.1f} GiB of {what} that one job may use here."
    return problem_document(reason, detail, limit_bytes=limit)


def are_files_away(error: Exception) -> bool:
    """Whether stored files fail or are missing: usually the volume is away, and another attempt may succeed."""
    return isinstance(error, OSError) and error.errno in _AWAY


def start_refused(error: OSError) -> str | None:
    """The reason of a job for which no process could be started, where there is one of its own."""
    if error.errno in _FULL:
        return "STORAGE_FULL"
    return "STORAGE_UNAVAILABLE" if are_files_away(error) else None


def new_incident() -> str:
    """A word by which a person finds a fault in the log."""
    return uuid4().hex[:12]


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory ran out. torch says so in a RuntimeError on a CPU, in a subclass of it on a GPU."""
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and any(phrase in str(error).lower() for phrase in _OUT_OF_MEMORY_PHRASES)
    )
