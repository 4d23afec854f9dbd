"""Detection boxes as plain numbers: normal form, and whether one meets the scene's bounds at all."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from regnf_core.geometry.quaternion_formula import rotation_rows

Vector = tuple[float, float, float]
IDENTITY = (0.0, 0.0, 0.0, 1.0)
_DIGITS = 12


def normal_quaternion(xyzw: Sequence[float]) -> tuple[float, ...]:
    """The unit quaternion of the same rotation whose last non-zero component is positive, to twelve digits.

    A quaternion and its negative are one rotation, and so is any multiple: all must give one job.
    """
    norm = math.hypot(*xyzw)
    last = next(value for value in reversed(xyzw) if value != 0)
    return tuple(round(value / math.copysign(norm, last), _DIGITS) + 0.0 for value in xyzw)


def rotation_columns(xyzw: Sequence[float]) -> tuple[Vector, Vector, Vector]:
    """The box's axes in the scene's frame, from a unit quaternion."""
    x, y, z, w = xyzw
    first, second, third = zip(*rotation_rows(x, y, z, w), strict=True)
    return first, second, third


def boxes_overlap(
    center: Sequence[float],
    size: Sequence[float],
    xyzw: Sequence[float],
    lower: Sequence[float],
    upper: Sequence[float],
) -> bool:
    """Whether an oriented box meets the axis-aligned box lower..upper: the separating axis theorem, all fifteen axes.

    center, size (full edges), lower, upper: three numbers each, scene frame.
    """
    columns = rotation_columns(xyzw)
    offset = tuple(c - (low + high) / 2 for c, low, high in zip(center, lower, upper, strict=True))
    half_bounds = tuple((high - low) / 2 for low, high in zip(lower, upper, strict=True))
    world: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    crosses = (_cross(a, b) for a, b in itertools.product(world, columns))
    for axis in itertools.chain(world, columns, crosses):
        reach_box = sum(edge / 2 * abs(_dot(axis, column)) for edge, column in zip(size, columns, strict=True))
        reach_bounds = sum(half * abs(value) for half, value in zip(half_bounds, axis, strict=True))
        if abs(_dot(axis, offset)) > reach_box + reach_bounds:
            return False
    return True


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
