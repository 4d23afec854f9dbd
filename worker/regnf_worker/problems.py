"""What went wrong, as the problem object that a record carries. No traceback and no path ever leaves through here."""

from __future__ import annotations

import errno
from typing import Any
from uuid import uuid4

from regnf_core.errors import RegnfError
from regnf_state.blobs.base import StorageFullError
from regnf_state.problems import problem_document
from regnf_worker.job_limits import JobLimits

OVER_LIMIT = {"JOB_MEMORY_LIMIT": "memory", "JOB_DISK_LIMIT": "temporary files"}
"""Reasons of jobs that were over a limit, and of what."""
_LIMIT_OF = {"JOB_MEMORY_LIMIT": "memory", "JOB_DISK_LIMIT": "scratch"}
_SETTING_OF = {
    "IMPORT_TIMEOUT": "REGNF_IMPORT_TIMEOUT_S",
    "IMPORT_TOO_COSTLY": "REGNF_IMPORT_WORK_S",
    "IMPORT_OUT_OF_MEMORY": "REGNF_IMPORT_MEMORY_BYTES",
    "JOB_TIMEOUT": "REGNF_JOB_TIMEOUT_S",
}
"""The settings of the limits, by the reasons that go with them."""
_GIB = 1 << 30
_OUT_OF_MEMORY_PHRASES = ("can't allocate memory", "out of memory", "cannot allocate memory", "bad_alloc")
_FULL = {errno.ENOSPC, errno.EDQUOT}
_AWAY = {errno.ENOENT, errno.EIO, errno.ENODEV, errno.ENXIO, errno.ENOTCONN, errno.EROFS, errno.ESTALE}


def refusal(error: RegnfError) -> dict[str, Any]:
    """The problem of one of regnf's own refusals. Where a setting of the service set the limit, it is named."""
    setting = _SETTING_OF.get(error.reason)
    detail = str(error) if setting is None else f"{error} ({setting})"
    return problem_document(error.reason, detail, hint=error.hint)


def timeout(reason: str, limit_s: float) -> dict[str, Any]:
    """The problem of work that the worker stopped: JOB_TIMEOUT or IMPORT_TIMEOUT."""
    what = "job" if reason == "JOB_TIMEOUT" else "import"
    detail = f"the {what} took longer than the {limit_s:g} s that it may ({_SETTING_OF[reason]})"
    return problem_document(reason, detail)


def fault(error: Exception, incident: str, limits: JobLimits | None = None) -> dict[str, Any]:
    """The problem of an exception that is not one of regnf's own refusals; ``incident`` finds it in the log.

    limits: those that hold for this process, if any do.
    """
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
