"""JSON of a request: each member once, no wild nesting. Its encoding is told as that of files is: a person may have
written the body with any editor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from regnf_core.errors import InvalidInputError
from regnf_core.texts import json_value
from regnf_service.problem import Problem

# How many values a JSON text can hold, counted before it is parsed: the bytes alone say little of the work.

_SEPARATORS = (b",", b":", b"[", b"{")
MOST_VALUES = 4096
"""Twice what a search among the most candidates takes, each written at its longest."""
MOST_VALUES_WITH_CAMERAS = 16384
"""Of a request that may hold a file of cameras: some 600 of them."""
MOST_MEMBERS = 256
"""Of one object. No object of the contract has half as many."""


def count_values(text: bytes) -> int:
    """At least as many as the values and members in it: whatever separates them, in strings too."""
    return sum(map(text.count, _SEPARATORS))


_MAX_DEPTH = 32
_LARGEST_EXACT = 2**53


def parse_json(body: bytes, most_values: int = MOST_VALUES, what: str = "The body") -> Any:
    """The value in ``body``, which messages call ``what``.

    A number without a fraction is an int, as JSON Schema has it, however it is spelled.
    NaN and Infinity are accepted here; the schema refuses them with their place.

    Raises Problem MALFORMED_JSON, REQUEST_TOO_LARGE for more values than any request needs.
    """
    if count_values(body) > most_values:
        raise Problem("REQUEST_TOO_LARGE", f"The JSON can have at most {most_values} members and values.")
    try:
        value = json_value(body, f"{what} is ", object_pairs_hook=_object, parse_float=_number)
    except InvalidInputError as error:
        raise Problem("MALFORMED_JSON", f"{error}.", hint=error.hint) from error
    _check_depth(value)
    return value


def _number(text: str) -> float | int:
    value = float(text)
    return int(value) if value.is_integer() and abs(value) <= _LARGEST_EXACT else value


def _object(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    if len(pairs) > MOST_MEMBERS:
        raise Problem("REQUEST_TOO_LARGE", f"An object can have at most {MOST_MEMBERS} members.")
    members = dict(pairs)
    if len(members) != len(pairs):
        raise Problem("MALFORMED_JSON", "An object has a member twice.")
    return members


def _check_depth(value: Any) -> None:
    level = [value]
    for _ in range(_MAX_DEPTH):
        level = [child for item in level if isinstance(item, dict | list) for child in _children(item)]
        if not level:
            return
    raise Problem("MALFORMED_JSON", "The body is nested too deeply.")


def _children(item: dict[str, Any] | list[Any]) -> list[Any]:
    return list(item.values()) if isinstance(item, dict) else item
