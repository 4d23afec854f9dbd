"""The limit on estimated work."""

from __future__ import annotations

from regnf_core.errors import FieldFormatError


def require_within(seconds: float, work_s: float) -> None:
    """Raise FieldFormatError (IMPORT_TOO_COSTLY) when more seconds are estimated than allowed."""
    if seconds > work_s:
        message = f"the field's checks would take an estimated {seconds:.0f} s of a core; {work_s:g} s are allowed"
        raise FieldFormatError(message, reason="IMPORT_TOO_COSTLY")
