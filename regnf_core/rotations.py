"""Rotations as plain numbers: quaternions (x, y, z, w) and 3x3 matrices. Torch-free."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from torch import Tensor

Number = TypeVar("Number", float, "Tensor")
Row = tuple[Number, Number, Number]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)
_DIGITS = 12


def rotation_rows(x: Number, y: Number, z: Number, w: Number) -> tuple[Row[Number], Row[Number], Row[Number]]:
    """The three rows of the rotation matrix of the unit quaternion x, y, z (vector part), w (real part).

    The numbers may be tensors of one shape; each entry then is such a tensor.
    """
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )


def normal_quaternion(xyzw: Sequence[float]) -> Quaternion:
    """The unit quaternion of the same rotation whose last non-zero component is positive, to twelve digits.

    A quaternion and its negative are one rotation, and so is any multiple: all must give one job.
    """
    norm = math.hypot(*xyzw)
    last = next(value for value in reversed(xyzw) if value != 0)
    x, y, z, w = (round(value / math.copysign(norm, last), _DIGITS) + 0.0 for value in xyzw)
    return x, y, z, w


def rotation_columns(xyzw: Sequence[float]) -> tuple[Vector, Vector, Vector]:
    """The images of the axes x, y and z, from a unit quaternion."""
    x, y, z, w = xyzw
    first, second, third = zip(*rotation_rows(x, y, z, w), strict=True)
    return first, second, third


def orthonormality_error(rows: Sequence[Sequence[float]]) -> float:
    """The largest entry of ``|R R^T - I|``: 0 for a rotation or a reflection."""
    return max(abs(dot(a, b) - (i == j)) for i, a in enumerate(rows) for j, b in enumerate(rows))


def determinant(rows: Sequence[Sequence[float]]) -> float:
    """The determinant of a 3x3 matrix: 1 for a rotation, -1 for a reflection."""
    a, b, c = rows
    return dot(cross(a, b), c)


def quaternion_of(rows: Sequence[Sequence[float]]) -> Quaternion:
    """The quaternion (x, y, z, w), not normalized, of a 3x3 rotation matrix given by rows."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    # the candidate with the largest component loses the fewest digits
    candidates: list[Quaternion] = [
        (h - f, c - g, d - b, 1 + a + e + i),
        (1 + a - e - i, b + d, c + g, h - f),
        (b + d, 1 - a + e - i, f + h, c - g),
        (c + g, f + h, 1 - a - e + i, d - b),
    ]
    return max(candidates, key=lambda q: max(map(abs, q)))


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
