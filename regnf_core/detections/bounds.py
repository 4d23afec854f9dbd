"""Whether a box overlaps the scene, its distance from the scene, and possible errors of its units."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from regnf_core.errors import InvalidDetectionError
from regnf_core.library_entries import shown_number
from regnf_core.rotations import IDENTITY, Quaternion, Vector, cross, dot, normal_quaternion, rotation_columns

# A detection in its one form: center, full edge lengths, quaternion.


@dataclass(frozen=True)
class Detection:
    """An oriented box as plain numbers, in the scene's frame and units.

    center: (x, y, z) · size: full edge lengths along the box's own axes, all > 0 · rotation_quaternion_xyzw: box axes
    to scene axes, not necessarily normalized. Made by :func:`parse_detection`, which checks every number.
    """

    center: Vector
    size: Vector
    rotation_quaternion_xyzw: Quaternion = IDENTITY
    label: str | None = None
    score: float | None = None

    def normal(self) -> Detection:
        """The same box in its one spelling: equal boxes are equal, however they were written."""
        x, y, z = self.center
        quaternion = normal_quaternion(self.rotation_quaternion_xyzw)
        # adding zero turns -0.0 into 0.0
        return replace(self, center=(x + 0.0, y + 0.0, z + 0.0), rotation_quaternion_xyzw=quaternion)

    def values(self) -> dict[str, Any]:
        """Its members as plain (JSON) values."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in vars(self).items()}

    def canonical(self) -> dict[str, Any]:
        """The plain values of its one spelling, for requests."""
        return self.normal().values()


Bounds = tuple[Sequence[float], Sequence[float]]
"""Lowest and highest corner."""
_UNITS = {1000.0: "millimeters", 100.0: "centimeters", 39.37: "inches"}
_WORLD: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_MAX_SIZE_RATIO = 10.0
"""A box whose shortest edge is longer than this many times the scene's longest is of another unit."""
_MIN_FIT_RATIO = 0.04
"""A box whose longest edge is less than this share of the scene's longest does not count as fitting."""
_MIN_AXIS_SQUARED = 1e-12


def require_in_scene(box: Detection, scene: Bounds, obj: Bounds | None = None) -> None:
    """Raises InvalidDetectionError for a box that does not overlap the scene's bounds (DETECTION_OUTSIDE_SCENE).

    A box many times larger than the whole scene is INVALID_DETECTION. ``obj``, the object's bounds, tells whether
    scene and object may be swapped.
    """
    if not all(math.isfinite(value) for corner in scene for value in corner):
        return
    apart = distance(box, scene)
    if apart > 0:
        message = f"the box is {apart:.3g} units from the scene's bounds: {_described(box, scene)}"
        raise InvalidDetectionError(message, reason="DETECTION_OUTSIDE_SCENE", hint=_hint(box, scene, obj))
    if min(box.size) > _MAX_SIZE_RATIO * max(_edges(scene)):
        message = f"the box is many times larger than the scene: {_described(box, scene)}"
        raise InvalidDetectionError(message, hint=_hint(box, scene, obj))


def distance(box: Detection, bounds: Bounds) -> float:
    """0 where the box meets the bounds; else how far apart they are at least, along the widest gap."""
    lower, upper = bounds
    columns = rotation_columns(normal_quaternion(box.rotation_quaternion_xyzw))
    offset = tuple(c - (low + high) / 2 for c, low, high in zip(box.center, lower, upper, strict=True))
    half_bounds = [edge / 2 for edge in _edges(bounds)]
    gaps = []
    for axis in _separating_axes(columns):
        reach_box = sum(edge / 2 * abs(dot(axis, column)) for edge, column in zip(box.size, columns, strict=True))
        reach_bounds = sum(half * abs(value) for half, value in zip(half_bounds, axis, strict=True))
        gaps.append(abs(dot(axis, offset)) - reach_box - reach_bounds)
    along_axes = math.hypot(*(max(gap, 0.0) for gap in gaps[:3]))
    return max(along_axes, *gaps, 0.0)


def _separating_axes(columns: tuple[Vector, Vector, Vector]) -> Iterator[Vector]:
    """The fifteen unit axes of the separating axis theorem, the world's three first; no axis of parallel edges."""
    yield from _WORLD
    yield from columns
    for a, b in itertools.product(_WORLD, columns):
        axis = cross(a, b)
        squared = dot(axis, axis)
        if squared > _MIN_AXIS_SQUARED:
            length = math.sqrt(squared)
            yield (axis[0] / length, axis[1] / length, axis[2] / length)


def _hint(box: Detection, scene: Bounds, obj: Bounds | None) -> str:
    if obj is not None and _fits(box, obj):
        return "The box is within the object's bounds. Check whether scene and object are swapped."
    for inverse, said in (
        (True, "Is the box in {}? Divided by {} it fits. Write it in the scene's units."),
        (False, "Is the scene in {}? Times {} the box fits. Write it in the scene's units."),
    ):
        fitting = [f for f in _UNITS if _fits(_scaled(box, 1 / f if inverse else f), scene)]
        if fitting:
            return said.format(" or ".join(_UNITS[f] for f in fitting), " or ".join(f"{f:g}" for f in fitting))
    return "Write the box in the scene field's own frame and units; `regnf inspect` shows the field's bounds."


def _fits(box: Detection, bounds: Bounds) -> bool:
    """The center lies within the bounds, and the box is neither larger than they are nor a speck."""
    inside = all(low <= c <= high for c, low, high in zip(box.center, *bounds, strict=True))
    return inside and _MIN_FIT_RATIO <= max(box.size) / max(_edges(bounds)) <= 1


def _scaled(box: Detection, factor: float) -> Detection:
    center, size = (tuple(value * factor for value in values) for values in (box.center, box.size))
    return Detection(center, size, box.rotation_quaternion_xyzw)  # type: ignore[arg-type]  # of three, as they were


def _edges(bounds: Bounds) -> list[float]:
    return [high - low for low, high in zip(*bounds, strict=True)]


def _described(box: Detection, scene: Bounds) -> str:
    lower, upper = scene
    return (
        f"the center is {_vector(box.center)} and the size {_vector(box.size)}, "
        f"the scene reaches from {_vector(lower)} to {_vector(upper)}"
    )


def _vector(values: Sequence[float]) -> str:
    return f"[{', '.join(map(shown_number, values))}]"


# Reading the numbers of a detection; a number that cannot be used is refused with its place and its value.

Place = tuple[str | int, ...]
MAX_COORDINATE = 1e9
"""Largest coordinate and edge length: float64 keeps a ten-millionth there."""
_MAX_SHOWN = 60
_HINT = "docs/api.md shows every form of a detection."
_PLAIN = re.compile(r"[A-Za-z0-9_.+-]{1,40}")


def fault(place: Place, message: str, hint: str | None = None) -> InvalidDetectionError:
    """The error for the member at ``place``; the message begins with its name: detection.center[0]."""
    name = "detection" + "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return InvalidDetectionError(f"{name} {message}", hint=hint or _HINT, place=place)


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
        hint = "Detectors write this for a box without a position. Leave such boxes out."
        raise fault(place, f"is {shown(value)}, expected a finite number", hint)
    if abs(value) > limit:
        message = f"is {shown(value)}, expected an absolute value of at most {limit:g}"
        raise fault(place, message, "Move the origin of the scene and the box nearer.")
    return float(value)


def numbers(value: Any, place: Place, axes: str, limit: float = MAX_COORDINATE) -> tuple[float, ...]:
    """As many numbers as ``axes`` has letters: a list, or an object with these letters as members."""
    letters = ", ".join(axes)
    if isinstance(value, Mapping):
        if set(value) != set(axes):
            raise fault(place, f"has other members than {letters}", f"Write [{letters}].")
        return tuple(number(value[axis], (*place, axis), limit) for axis in axes)
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise fault(place, f"is {shown(value)}, expected {len(axes)} numbers", f"Write [{letters}].")
    if len(value) != len(axes):
        count = {0: "no entries", 1: "1 number"}.get(len(value), f"{len(value)} entries")
        raise fault(place, f"has {count}, expected {len(axes)}", f"Write [{letters}].")
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
            hint = "Sizes are full edge lengths. For corners, write `min` and `max`."
            if edge == 0:
                hint = (
                    "A box needs an extent along every axis. Make a flat box at least as thick as the noise of "
                    "the surface."
                )
            raise fault((*place, part), f"is {edge:g}, expected an edge length above 0", hint)
    return x, y, z
