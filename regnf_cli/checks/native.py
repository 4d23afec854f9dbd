"""The native evaluator: whether fields are evaluated by compiled code or with torch."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator

from regnf_cli.checks.finding import Finding

_SUBJECT = "evaluator"
_SLOWER = "Registrations take 30 to 50 percent longer than with it."
_BUILD = "With a C compiler (apt-get install gcc libc6-dev) it is built when regnf is installed."


def check_native() -> Iterator[Finding]:
    """One finding where the engine is installed. To be without compiled code is no fault."""
    if importlib.util.find_spec("torch") is None:
        return
    from regnf_core.fields.native.library import NOT_BUILT, SWITCH, load

    found = load()
    if os.environ.get(SWITCH) == "0":
        yield Finding(_SUBJECT, "ok", f"torch: compiled code is off, {SWITCH} is 0", _SLOWER)
    elif found.fastest is None:
        hint = f"{_SLOWER} {_BUILD}" if found.fault == NOT_BUILT else _SLOWER
        yield Finding(_SUBJECT, "ok", f"torch: compiled code {found.fault}", hint)
    else:
        yield Finding(_SUBJECT, "ok", f"compiled code, {found.fastest.name}")
