"""The keys of one settings file, requested by path and by type. What nobody asks for is never looked at."""

from __future__ import annotations

import itertools
import json
import math
import re
from dataclasses import dataclass
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.texts import TextError, decode_text

# What the readers of settings files give: plain values. A tag of YAML stays a text beside its value.

MAX_DEPTH = 48
MAX_NODES = 60_000
MAX_NUMBER_CHARACTERS = 40
"""No trainer writes a longer one."""


@dataclass(frozen=True)
class Tagged:
    """A value that the file wants made into an object of ``tag``. Nothing is made: ``value`` is what was written."""

    tag: str
    value: Any


def malformed(message: str) -> FieldFormatError:
    """The error for settings that break their format."""
    return FieldFormatError(message, reason="SETTINGS_MALFORMED")


def too_large(message: str) -> FieldFormatError:
    """The error for settings beyond what any trainer writes."""
    return FieldFormatError(message, reason="SETTINGS_TOO_LARGE")


def unsafe(message: str) -> FieldFormatError:
    """The error for settings that ask for another file, or for the environment."""
    return FieldFormatError(message, reason="SETTINGS_UNSAFE")


def decoded(name: str, data: bytes | memoryview, most: int) -> str:
    """The file as text. Raises FieldFormatError: SETTINGS_TOO_LARGE, SETTINGS_MALFORMED."""
    if len(data) > most:
        raise too_large(f"{name} has {len(data)} bytes; at most {most} are allowed")
    try:
        return decode_text(data)
    except TextError as error:
        raise malformed(f"{name} is {error}") from error


def looks_like_json(data: bytes | memoryview) -> bool:
    """Whether a text begins with a brace, in whatever encoding."""
    return bytes(data[:64]).strip(b"\xef\xbb\xbf\xfe\xff\0 \t\r\n")[:1] == b"{"


def plain(value: Any) -> Any:
    """The value below its tags."""
    while isinstance(value, Tagged):
        value = value.value
    return value


@dataclass(frozen=True)
class Keys:
    """A part of one settings file. Paths have dots between keys; absent keys and nulls are None."""

    file: str
    tree: Any
    at: str = ""
    """The path of this part."""

    def find(self, path: str) -> Any:
        """The plain value at ``path``, tags left out."""
        here = plain(self.tree)
        for part in path.split(".") if path else ():
            here = plain(here.get(part)) if isinstance(here, dict) else None
        return here

    def tag(self) -> str:
        """What this part would be an object of, or ''."""
        return self.tree.tag if isinstance(self.tree, Tagged) else ""

    def below(self, path: str) -> Keys:
        return Keys(self.file, self.find(path), f"{self.at}{path}.")

    def has(self, path: str) -> bool:
        """Whether there is a value other than null."""
        return self.find(path) is not None

    def number(self, path: str) -> float | None:
        """A finite number. Raises FieldFormatError (SETTINGS_MALFORMED) for anything else."""
        value = self.find(path)
        return None if value is None else self._finite(path, value)

    def whole(self, path: str) -> int | None:
        """A whole number, also one written as 16.0. Raises FieldFormatError (SETTINGS_MALFORMED)."""
        number = self.number(path)
        if number is None:
            return None
        if number != int(number) or abs(number) >= 1 << 53:
            raise self.fault(path, "a whole number")
        return int(number)

    def flag(self, path: str) -> bool | None:
        """True or false. Raises FieldFormatError (SETTINGS_MALFORMED)."""
        value = self.find(path)
        if value is None or isinstance(value, bool):
            return value
        raise self.fault(path, "true or false")

    def text(self, path: str) -> str | None:
        """A text. Raises FieldFormatError (SETTINGS_MALFORMED)."""
        value = self.find(path)
        if value is None or isinstance(value, str):
            return value
        raise self.fault(path, "a text")

    def numbers(self, path: str, most: int = 64) -> list[float] | None:
        """A list of finite numbers. Raises FieldFormatError (SETTINGS_MALFORMED)."""
        values = self.find(path)
        if values is None:
            return None
        if not isinstance(values, list) or len(values) > most:
            raise self.fault(path, f"a list of at most {most} numbers")
        return [self._finite(f"{path}.{index}", plain(value)) for index, value in enumerate(values)]

    def wholes(self, path: str) -> list[int] | None:
        """A list of whole numbers. Raises FieldFormatError (SETTINGS_MALFORMED)."""
        values = self.numbers(path)
        if values is not None and any(value != int(value) for value in values):
            raise self.fault(path, "a list of whole numbers")
        return None if values is None else [int(value) for value in values]

    def matrix(self, path: str, rows: int, columns: int) -> list[list[float]] | None:
        """Rows of finite numbers. Raises FieldFormatError (SETTINGS_MALFORMED)."""
        values = self.find(path)
        if values is None:
            return None
        lines = (
            {str(i): row for i, row in enumerate(values)} if isinstance(values, list) and len(values) == rows else {}
        )
        below = Keys(self.file, lines, f"{self.at}{path}.")
        found = [below.numbers(line) or [] for line in lines]
        if len(found) != rows or any(len(row) != columns for row in found):
            raise self.fault(path, f"{rows} rows of {columns} numbers")
        return found

    def fault(self, path: str, expected: str) -> Exception:
        """The error for a value of another type than ``expected``."""
        return malformed(f"{self.file}: {self.at}{path} is not {expected}")

    def _finite(self, path: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < math.inf:
            raise self.fault(path, "a number")
        return float(value)


# JSON of a trainer: duplicate keys, depth and size are looked at before or while Python's own reader reads it.

MAX_BYTES = 8 << 20
MAX_VALUES = 400_000
"""Commas and colons; a list of two thousand cameras has a tenth of them."""


def read_json(name: str, data: bytes | memoryview, lost: bool = False) -> Any:
    """The value in the file ``name``. lost: NaN and infinity, which JSON has not, are None.

    Raises FieldFormatError: SETTINGS_TOO_LARGE, SETTINGS_MALFORMED.
    """
    text = decoded(name, data, MAX_BYTES)
    if text.count(",") + text.count(":") > MAX_VALUES:
        raise too_large(f"{name} holds more than {MAX_VALUES} values")
    if text.count("[") + text.count("{") > MAX_DEPTH and _depth(text) > MAX_DEPTH:
        raise too_large(f"{name} is nested more than {MAX_DEPTH} deep")
    constant = (lambda _: None) if lost else _no_constant
    try:
        return json.loads(text, object_pairs_hook=_object, parse_constant=constant, parse_int=_whole)
    except (ValueError, RecursionError) as error:
        raise malformed(f"{name} is not valid JSON") from error


def _depth(text: str) -> int:
    """How deep brackets nest, those within texts left out."""
    brackets = re.sub(r"[^\[\]{}]+", "", re.sub(r'"(?:[^"\\]|\\.)*"?', "", text, flags=re.DOTALL))
    return max(itertools.accumulate(1 if bracket in "[{" else -1 for bracket in brackets))


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
