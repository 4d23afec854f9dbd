"""What a check has found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """subject: what was looked at · state: a warning leaves regnf usable, an error does not · hint: how to mend it."""

    subject: str
    state: State
    found: str
    hint: str | None = None
