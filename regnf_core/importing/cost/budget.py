"""The limits on estimated work and memory."""

from __future__ import annotations

from regnf_core.errors import FieldFormatError

_LIBRARIES = 3 << 29


def require_within(seconds: float, work_s: float) -> None:
    """Raise FieldFormatError (IMPORT_TOO_COSTLY) when more seconds are estimated than allowed."""
    if seconds > work_s:
        message = f"the field's checks would take an estimated {seconds:.0f} s of a core; {work_s:g} s are allowed"
        raise FieldFormatError(message, reason="IMPORT_TOO_COSTLY")


def require_room(needed: int, memory_bytes: int) -> None:
    """Raise FieldFormatError (IMPORT_TOO_COSTLY) when more bytes are estimated than libraries and upload leave."""
    room = max(memory_bytes - _LIBRARIES, memory_bytes // 2)
    if needed > room:
        message = f"the field's values would take an estimated {needed >> 20} MiB at once; {room >> 20} MiB are free"
        raise FieldFormatError(message, reason="IMPORT_TOO_COSTLY")
