"""The keys of one settings file, asked for by path and by type. What nobody asks for is never looked at."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from regnf_core.importing.settings.plain import Tagged, malformed, plain

_SHOWN = 60


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

    def tag(self, path: str = "") -> str:
        """What the value at ``path`` would be an object of, or ''."""
        parent, _, last = path.rpartition(".")
        holder = self.find(parent) if last else None
        value = holder.get(last) if isinstance(holder, dict) else None if last else self.tree
        return value.tag if isinstance(value, Tagged) else ""

    def below(self, path: str) -> Keys:
        """The part at ``path``."""
        return Keys(self.file, self.find(path), f"{self.at}{path}.")

    def has(self, path: str) -> bool:
        """Whether there is a value other than null."""
        return self.find(path) is not None

    def number(self, path: str) -> float | None:
        """A finite number. Raises FieldFormatError (SETTINGS_MALFORMED) for anything else."""
        value = self.find(path)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < math.inf:
            raise self.fault(path, "a number")
        return float(value)

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
        here = Keys(self.file, dict(enumerate(values)), f"{self.at}{path}.")
        return [here._element(index, plain(value)) for index, value in enumerate(values)]

    def wholes(self, path: str, most: int = 64) -> list[int] | None:
        """A list of whole numbers. Raises FieldFormatError (SETTINGS_MALFORMED)."""
        values = self.numbers(path, most)
        if values is None:
            return None
        if any(value != int(value) for value in values):
            raise self.fault(path, "a list of whole numbers")
        return [int(value) for value in values]

    def matrix(self, path: str, rows: int, columns: int) -> list[list[float]] | None:
        """Rows of finite numbers. Raises FieldFormatError (SETTINGS_MALFORMED)."""
        values = self.find(path)
        if values is None:
            return None
        if not isinstance(values, list) or len(values) != rows:
            raise self.fault(path, f"{rows} rows of {columns} numbers")
        here = Keys(self.file, {str(index): value for index, value in enumerate(values)}, f"{self.at}{path}.")
        found = [here.numbers(str(index)) or [] for index in range(rows)]
        if any(len(row) != columns for row in found):
            raise self.fault(path, f"{rows} rows of {columns} numbers")
        return found

    def fault(self, path: str, expected: str) -> Exception:
        """The error for a value of another type than ``expected``."""
        return malformed(f"{self.file}: {self.at}{path} is not {expected}")

    def _element(self, index: int, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < math.inf:
            raise self.fault(str(index), "a number")
        return float(value)
