"""Whether a box meets the scene at all, how far away it is, and what may be wrong with its units."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

from regnf_core.detections.detection import Detection
from regnf_core.errors import InvalidDetectionError
from regnf_core.labels import shown_number
from regnf_core.rotations import Vector, cross, dot, normal_quaternion, rotation_columns

Bounds = tuple[Sequence[float], Sequence[float]]
"""Lowest and highest corner."""
_UNITS = ((1000.0, "millimeters"), (100.0, "centimeters"), (39.37, "inches"))
_WORLD: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_MAX_SIZE_RATIO = 10.0
"""A box whose shortest edge is longer than this many times the scene's longest is of another unit."""
_MIN_FIT_RATIO = 0.04
"""A box whose longest edge is less than this share of the scene's longest does not count as fitting."""
_MIN_AXIS_SQUARED = 1e-12


def require_in_scene(box: Detection, scene: Bounds, obj: Bounds | None = None) -> None:
    """Raises InvalidDetectionError for a box that does not meet the scene's bounds (DETECTION_OUTSIDE_SCENE).

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
        return "The box lies within the object's bounds: are scene and object swapped?"
    if small := [(unit, f"{factor:g}") for factor, unit in _UNITS if _fits(_scaled(box, 1 / factor), scene)]:
        units, factors = (" or ".join(words) for words in zip(*small, strict=True))
        return f"Is the box in {units}? Divided by {factors} it fits. Write it in the scene's units."
    if large := [(unit, f"{factor:g}") for factor, unit in _UNITS if _fits(_scaled(box, factor), scene)]:
        units, factors = (" or ".join(words) for words in zip(*large, strict=True))
        return f"Is the scene in {units}? Times {factors} the box fits. Write it in the scene's units."
    return "Write the box in the scene field's own frame and units; `regnf inspect` shows the field's bounds."


def _fits(box: Detection, bounds: Bounds) -> bool:
    """The center lies within the bounds, and the box is neither larger than they are nor a speck."""
    inside = all(low <= c <= high for c, low, high in zip(box.center, *bounds, strict=True))
    return inside and _MIN_FIT_RATIO <= max(box.size) / max(_edges(bounds)) <= 1


def _scaled(box: Detection, factor: float) -> Detection:
    def times(values: Vector) -> Vector:
        return values[0] * factor, values[1] * factor, values[2] * factor

    return Detection(times(box.center), times(box.size), box.rotation_quaternion_xyzw)


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
