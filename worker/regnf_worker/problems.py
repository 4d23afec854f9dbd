"""What went wrong, as the problem object that a record carries. No traceback and no path ever leaves through here."""

from __future__ import annotations

import errno
from typing import Any
from uuid import uuid4

from rq.timeouts import JobTimeoutException

from regnf_state.blobs.base import StorageFullError
from regnf_state.problems import problem_document

_OUT_OF_MEMORY_PHRASES = ("can't allocate memory", "out of memory", "cannot allocate memory")
_FULL = {errno.ENOSPC, errno.EDQUOT}
_AWAY = {errno.ENOENT, errno.EIO, errno.ENODEV, errno.ENXIO, errno.ENOTCONN, errno.EROFS, errno.ESTALE}


def fault(error: Exception, incident: str) -> dict[str, Any]:
    """The problem of an exception that is not one of regnf's own refusals; ``incident`` finds it in the log."""
    if isinstance(error, JobTimeoutException):
        return problem_document("JOB_TIMEOUT")
    if is_out_of_memory(error):
        return problem_document("OUT_OF_MEMORY")
    if isinstance(error, StorageFullError) or (isinstance(error, OSError) and error.errno in _FULL):
        return problem_document("STORAGE_FULL")
    return problem_document("INTERNAL", f"Internal error. The log has it under incident {incident}.", incident=incident)


def are_files_away(error: Exception) -> bool:
    """Whether stored files fail or are missing: usually the volume is away, and another attempt may succeed."""
    return isinstance(error, OSError) and error.errno in _AWAY


def new_incident() -> str:
    """A word by which a person finds a fault in the log."""
    return uuid4().hex[:12]


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory ran out. torch says so in a RuntimeError on a CPU, in a subclass of it on a GPU."""
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and any(phrase in str(error).lower() for phrase in _OUT_OF_MEMORY_PHRASES)
    )
