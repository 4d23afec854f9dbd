"""The problem object (RFC 9457) of a reason: what a record keeps, and what an answer carries."""

from __future__ import annotations

from typing import Any

from regnf_core.hints import hint_of
from regnf_state.reasons import REASONS

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
