"""Reading the numbers of a detection; a number that cannot be used is refused with its place and its value."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from regnf_core.errors import InvalidDetectionError
from regnf_core.rotations import Vector

Place = tuple[str | int, ...]
MAX_COORDINATE = 1e9
"""Largest coordinate and edge length: float64 keeps a ten-millionth there."""
_MAX_SHOWN = 60
_HINT = "docs/api.md shows every form of a detection."
_PLAIN = re.compile(r"[A-Za-z0-9_.+-]{1,40}")


def fault(place: Place, message: str, hint: str | None = None) -> InvalidDetectionError:
    """The error for the member at ``place``; the message begins with the member's name."""
    return InvalidDetectionError(f"{said(place)} {message}", hint=hint or _HINT, place=place)


def said(place: Place) -> str:
    """A place as people write it: detection.center[0]."""
    return "detection" + "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)


def shown(value: Any) -> str:
    """A value in a message: numbers and plain words as they are, anything else by its kind."""
    match value:
        case None:
            return "null"
        case bool():
            return str(value).lower()
        case float() if math.isnan(value):
            return "NaN"
        case int() | float():
            return f"{value:g}" if isinstance(value, float) else str(value) if abs(value) < 1e30 else "a huge number"
        case str():
            return f'the text "{value}"' if _PLAIN.fullmatch(value) else "a text"
        case Mapping():
            return "an object"
        case Sequence():
            return f"a list of {len(value)}"
    return f"a {type(value).__name__[:_MAX_SHOWN]}"


def number(value: Any, place: Place, limit: float = MAX_COORDINATE) -> float:
    """A finite number of at most ``limit`` either way."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        hint = "Remove the quotation marks." if isinstance(value, str) else None
        raise fault(place, f"is {shown(value)}, expected a number", hint)
    if isinstance(value, float) and not math.isfinite(value):
        raise fault(
            place,
            f"is {shown(value)}, expected a finite number",
            "A detector writes this for a box that it could not place: leave such boxes out.",
        )
    if abs(value) > limit:
        message = f"is {shown(value)}, expected at most {limit:g} either way"
        raise fault(place, message, "Move the origin of scene and box nearer.")
    return float(value)


def numbers(value: Any, place: Place, axes: str, limit: float = MAX_COORDINATE) -> tuple[float, ...]:
    """As many numbers as ``axes`` has letters: a list, or an object with these letters as members."""
    if isinstance(value, Mapping):
        if set(value) != set(axes):
            raise fault(place, f"has other members than {', '.join(axes)}", f"Write {written(axes)}.")
        return tuple(number(value[axis], (*place, axis), limit) for axis in axes)
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise fault(place, f"is {shown(value)}, expected {len(axes)} numbers", f"Write {written(axes)}.")
    if len(value) != len(axes):
        raise fault(place, f"has {_count(len(value))}, expected {len(axes)}", f"Write {written(axes)}.")
    return tuple(number(part, (*place, i), limit) for i, part in enumerate(value))


def point(value: Any, place: Place) -> Vector:
    """Three coordinates."""
    x, y, z = numbers(value, place, "xyz")
    return x, y, z


def edges(value: Any, place: Place) -> Vector:
    """Three edge lengths, all positive."""
    x, y, z = point(value, place)
    for i, edge in enumerate((x, y, z)):
        if edge <= 0:
            part: str | int = "xyz"[i] if isinstance(value, Mapping) else i
            raise fault((*place, part), f"is {edge:g}, expected an edge length above 0", _edge_hint(edge))
    return x, y, z


def written(axes: str) -> str:
    return f"[{', '.join(axes)}]"


def _edge_hint(edge: float) -> str:
    if edge == 0:
        return "A box needs an extent along every axis; make a flat one as thick as the surface is noisy."
    return "Sizes are full edge lengths. If these are corners, write `min` and `max`."


def _count(count: int) -> str:
    return "1 number" if count == 1 else f"{count} entries" if count != 0 else "no entries"
