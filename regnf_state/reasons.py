"""Every reason the HTTP interface can give, with its status, title and meaning: reasons.toml.

It is the table that clients program against. Stable: a reason is never renamed, and never changes its meaning.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from regnf_core.errors import hint_of


@dataclass(frozen=True)
class Reason:
    """One way to be refused: its HTTP status, a short title, and what the caller can do about it."""

    status: int
    title: str
    meaning: str


REASONS = {
    name: Reason(*row)
    for name, row in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")).items()
}


# The problem object (RFC 9457) of a reason: what a record keeps, and what an answer carries.

_ENGINE_STATUS = 422


def problem_document(reason: str, detail: str | None = None, *, hint: str | None = None, **more: Any) -> dict[str, Any]:
    """The members of a problem. A reason that is not in REASONS is one of the engine's, which are about the input."""
    known = REASONS.get(reason)
    hint = hint or hint_of(reason)
    return {
        "type": f"/docs#{reason}",
        "title": known.title if known is not None else reason.replace("_", " ").capitalize(),
        "status": known.status if known is not None else _ENGINE_STATUS,
        "reason": reason,
        "detail": detail if detail is not None else known.meaning if known is not None else "",
        **({} if hint is None else {"hint": hint}),
        **more,
    }


def whole_problem(error: dict[str, Any]) -> dict[str, Any]:
    """A stored problem with every member that a problem has."""
    return problem_document(str(error.get("reason", "INTERNAL"))) | error
