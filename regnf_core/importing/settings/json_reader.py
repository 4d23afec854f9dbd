"""JSON of a trainer: duplicate keys, depth and size are looked at before or while Python's own reader reads it."""

from __future__ import annotations

import json
from typing import Any

from regnf_core.importing.settings.plain import MAX_DEPTH, MAX_NUMBER_CHARACTERS, decoded, malformed, too_large

MAX_BYTES = 8 << 20
MAX_VALUES = 400_000
"""Commas and colons; a list of two thousand cameras has a tenth of them."""


def read_json(name: str, data: bytes | memoryview) -> Any:
    """The value in the file ``name``. Raises FieldFormatError: SETTINGS_TOO_LARGE, SETTINGS_MALFORMED."""
    text = decoded(name, data, MAX_BYTES)
    if text.count(",") + text.count(":") > MAX_VALUES:
        raise too_large(f"{name} holds more than {MAX_VALUES} values")
    if text.count("[") + text.count("{") > MAX_DEPTH and _depth(text) > MAX_DEPTH:
        raise too_large(f"{name} is nested more than {MAX_DEPTH} deep")
    try:
        return json.loads(text, object_pairs_hook=_object, parse_constant=_no_constant, parse_int=_whole)
    except (ValueError, RecursionError) as error:
        raise malformed(f"{name} is no sound JSON") from error


def _depth(text: str) -> int:
    """How deep brackets nest, those within texts left out."""
    depth = deepest = 0
    in_text = escaped = False
    for character in text:
        if in_text:
            in_text = escaped or character != '"'
            escaped = character == "\\" and not escaped
        elif character == '"':
            in_text = True
        elif character in "[{":
            depth += 1
            deepest = max(deepest, depth)
        elif character in "]}":
            depth -= 1
    return deepest


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        raise ValueError("a key occurs twice")
    return values


def _no_constant(word: str) -> float:
    raise ValueError(f"{word} is not JSON")


def _whole(digits: str) -> int:
    """No float is as large as an int of some hundred digits."""
    if len(digits) > MAX_NUMBER_CHARACTERS:
        raise ValueError("a number of too many digits")
    return int(digits)
