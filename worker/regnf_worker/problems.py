"""What went wrong, as the problem object that a record carries. No traceback and no path ever leaves through here."""

from __future__ import annotations

import errno
from typing import Any
from uuid import uuid4

from rq.timeouts import JobTimeoutException

from regnf_core.hints import HINTS
from regnf_state.blobs.base import StorageFullError
from regnf_state.reasons import REASONS

_OUT_OF_MEMORY_PHRASES = ("can't allocate memory", "out of memory", "cannot allocate memory")
_UNFORESEEN_STATUS = 422
_FULL = {errno.ENOSPC, errno.EDQUOT}
_AWAY = {errno.ENOENT, errno.EIO, errno.ENODEV, errno.ENXIO, errno.ENOTCONN, errno.EROFS, errno.ESTALE}


def problem(reason: str, detail: str | None = None, *, hint: str | None = None, **extra: Any) -> dict[str, Any]:
    """A problem object (RFC 9457) for a stable reason. Unknown ones are the engine's refusals."""
    known = REASONS.get(reason)
    hint = hint or HINTS.get(reason)
    return {
        "type": f"/docs#{reason}",
        "title": known.title if known is not None else reason.replace("_", " ").capitalize(),
        "status": known.status if known is not None else _UNFORESEEN_STATUS,
        "reason": reason,
        "detail": detail if detail is not None else known.meaning if known is not None else "",
        **({} if hint is None else {"hint": hint}),
        **extra,
    }


def fault(error: Exception, incident: str) -> dict[str, Any]:
    """The problem that an exception stands for which is no refusal of regnf's own; ``incident`` finds it in the log."""
    if isinstance(error, JobTimeoutException):
        return problem("JOB_TIMEOUT")
    if is_out_of_memory(error):
        return problem("OUT_OF_MEMORY")
    if isinstance(error, StorageFullError) or (isinstance(error, OSError) and error.errno in _FULL):
        return problem("STORAGE_FULL")
    return problem("INTERNAL", f"Internal error. The log has it under incident {incident}.", incident=incident)


def are_files_away(error: Exception) -> bool:
    """Whether files of ours fail or are gone: the volume is away, as a rule, and it is worth another attempt."""
    return isinstance(error, OSError) and error.errno in _AWAY


def new_incident() -> str:
    """A word by which a person finds a fault in the log."""
    return uuid4().hex[:12]


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory ran out. torch says so in a RuntimeError on a CPU, in a subclass of it on a GPU."""
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and any(phrase in str(error).lower() for phrase in _OUT_OF_MEMORY_PHRASES)
    )
