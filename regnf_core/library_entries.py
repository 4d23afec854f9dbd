"""What a library says of an object: its name, tags, unit, note and symmetry. Torch-free."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from regnf_core.errors import InvalidInputError

# Names and numbers as people see them, and what of any text must not reach a line of a log.

UNSHOWN = r"\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ufff9-\ufffb"
"""Characters of control, of line breaks and of the direction of writing, as ranges of a regular expression."""
LABEL_PATTERN = rf"^[^{UNSHOWN}]*$"
"""Labels are shown as they are: nothing in them breaks a line or turns the text around them."""
MOST_OF_LABEL = 200
"""Characters."""


def shown_path(path: str) -> str:
    """The path of a file in a run or an archive; of a very long one, the end."""
    return path if len(path) <= MOST_OF_LABEL else f"...{path[-MOST_OF_LABEL:]}"


def shown_number(value: float) -> str:
    """A number as people read it: four digits, and of a large one, such as a coordinate in UTM, three decimals."""
    return f"{value:.4g}" if not 1e4 <= abs(value) < 1e12 else f"{value:.3f}".rstrip("0").rstrip(".")


UNITS = ("m", "cm", "mm", "in", "ft")
MAX_NAME, MAX_TAG, MAX_TAGS, MAX_NOTE, MAX_ORDER = 64, 32, 16, 500, 1000
_LEFT_OUT = UNSHOWN + r"/\\?#%\u00a0\u1680\u2000-\u200d\u202f\u205f\u2060\u3000"
"""Characters that are not shown, that an address or a path has another use for, and spaces that look like others."""


def text_pattern(most: int) -> str:
    """Of a name or a tag of at most ``most`` characters: no space at an end, no dot at the beginning."""
    return rf"^[^{_LEFT_OUT} .]([^{_LEFT_OUT}]{{0,{most - 2}}}[^{_LEFT_OUT} ])?$"


_NAME, _TAG = re.compile(text_pattern(MAX_NAME)), re.compile(text_pattern(MAX_TAG))


def checked_name(name: str) -> str:
    """The name of an entry. Raises InvalidInputError (LIBRARY_ENTRY_INVALID)."""
    return _checked(_NAME, name, "name", MAX_NAME)


def checked_tags(tags: Sequence[str]) -> list[str]:
    """Tags, each once, sorted. Raises InvalidInputError (LIBRARY_ENTRY_INVALID)."""
    several = sorted({_checked(_TAG, tag, "tag", MAX_TAG) for tag in tags})
    if len(several) > MAX_TAGS:
        raise _invalid(f"{len(several)} tags; at most {MAX_TAGS} are allowed")
    return several


def checked_symmetry(said: Any) -> dict[str, Any] | None:
    """A symmetry as results have it: order, axis and continuous, its axis of length 1.

    Raises InvalidInputError (LIBRARY_ENTRY_INVALID).
    """
    if said is None:
        return None
    match said:
        case {"order": int() as order, "axis": axis, "continuous": bool() as continuous} if len(said) == 3:
            if isinstance(order, bool) or not 1 <= order <= MAX_ORDER:
                raise _invalid(f"symmetry: the order must be a whole number from 1 to {MAX_ORDER}")
            if continuous and (axis is None or order > 2):
                raise _invalid("symmetry: a continuous symmetry needs an axis and the order 1 or 2")
            return {"order": order, "axis": None if axis is None else _unit(axis), "continuous": continuous}
    raise _invalid("symmetry: expected order, axis and continuous")


@dataclass(frozen=True)
class EntryNotes:
    """What people say of an object. symmetry: in place of the detected one; None: that holds."""

    name: str
    tags: tuple[str, ...] = ()
    unit: str | None = None
    note: str | None = None
    symmetry: dict[str, Any] | None = None

    @classmethod
    def checked(
        cls, name: str, tags: Sequence[str] = (), unit: str | None = None, note: str | None = None, symmetry: Any = None
    ) -> EntryNotes:
        """Raises InvalidInputError (LIBRARY_ENTRY_INVALID)."""
        if unit is not None and unit not in UNITS:
            raise _invalid(f"no such unit, expected one of {', '.join(UNITS)}")
        if note is not None and (len(note) > MAX_NOTE or re.search(f"[{UNSHOWN}]", note)):
            raise _invalid(f"a note must be one line of at most {MAX_NOTE} printable characters")
        return cls(checked_name(name), tuple(checked_tags(tags)), unit, note, checked_symmetry(symmetry))

    @classmethod
    def from_dict(cls, values: Any) -> EntryNotes:
        """Of a document that a file holds. Raises InvalidInputError (LIBRARY_ENTRY_INVALID)."""
        match values:
            case {"name": str() as name, "tags": list() as tags} if all(isinstance(tag, str) for tag in tags):
                unit, note = values.get("unit"), values.get("note")
                if all(text is None or isinstance(text, str) for text in (unit, note)):
                    return cls.checked(name, tags, unit, note, values.get("symmetry"))
        raise _invalid("expected a name, tags, a unit and a note as texts")

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        return asdict(self) | {"tags": list(self.tags)}


def _checked(pattern: re.Pattern[str], text: str, what: str, most: int) -> str:
    if pattern.fullmatch(text) is None:
        rule = "without / \\ ? # %, spaces at the ends, a dot at the beginning, or characters that are not printable"
        raise _invalid(f"a {what} must have 1 to {most} characters, {rule}")
    return text


def _unit(axis: Any) -> list[float]:
    numbers = axis if isinstance(axis, list | tuple) and len(axis) == 3 else ()
    if not numbers or not all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers):
        raise _invalid("symmetry: the axis needs three numbers")
    length = math.hypot(*numbers)
    if not math.isfinite(length) or length < 1e-9:
        raise _invalid("symmetry: the axis must not be zero")
    return [float(x) / length for x in numbers]


def _invalid(detail: str) -> InvalidInputError:
    return InvalidInputError(detail, reason="LIBRARY_ENTRY_INVALID", hint="docs/how-to/library.md has examples.")
