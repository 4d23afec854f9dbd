"""A document with several detections: which one is meant is asked, never guessed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from regnf_core.detections.names import FORMS
from regnf_core.detections.numbers import fault, shown
from regnf_core.errors import InvalidDetectionError

_LISTS = ("detections", "boxes", "objects", "predictions", "results")
_MAX_LISTED = 5


def chosen(values: Any, index: int | None) -> Any:
    """The one detection of a document: all of it, or the entry ``index`` of its list. Raises InvalidDetectionError."""
    name, entries = _entries(values)
    if entries is None:
        if index is not None:
            raise fault((), f"is a single box, and the entry {index} was asked for", "Leave the index out.")
        return values
    if not entries:
        raise fault((name,) if name else (), "is an empty list, expected a box", FORMS)
    if index is None:
        raise _ambiguous(name, entries)
    if not 0 <= index < len(entries):
        last = len(entries) - 1
        raise fault((name,) if name else (), f"has no entry {index}", f"Choose one of 0 to {last}.")
    return entries[index]


def _entries(values: Any) -> tuple[str | None, list[Any] | None]:
    """The list of detections in a document, and the member that holds it."""
    if isinstance(values, list) and (not values or any(isinstance(entry, Mapping) for entry in values)):
        return None, values
    if isinstance(values, Mapping):
        for name in _LISTS:
            if isinstance(values.get(name), list):
                return name, values[name]
    return None, None


def _ambiguous(name: str | None, entries: Sequence[Any]) -> InvalidDetectionError:
    listed = ", ".join(f"{number}: {_summary(entry)}" for number, entry in enumerate(entries[:_MAX_LISTED]))
    more = f" and {len(entries) - _MAX_LISTED} more" if len(entries) > _MAX_LISTED else ""
    count = "1 detection" if len(entries) == 1 else f"{len(entries)} detections"
    hint = f"Give the entry alone, without the list; at the command line --detection-index chooses it. {listed}{more}"
    return fault((name,) if name else (), f"is a list of {count}, expected one box", hint)


def _summary(entry: Any) -> str:
    if not isinstance(entry, Mapping):
        return shown(entry)
    label = next((entry[key] for key in ("label", "detection_name", "class", "name") if key in entry), None)
    score = next((entry[key] for key in ("score", "detection_score", "confidence") if key in entry), None)
    words = [shown(value) for value in (label, score) if isinstance(value, str | int | float)]
    return " ".join(words) or "a box"
