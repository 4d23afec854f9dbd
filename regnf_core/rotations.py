"""Rotations as plain numbers: quaternions (x, y, z, w) and 3x3 matrices. Torch-free."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor


Number = TypeVar("Number", float, "NDArray[np.float64]", "Tensor")
Row = tuple[Number, Number, Number]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)
_DIGITS = 12


def rotation_rows(x: Number, y: Number, z: Number, w: Number) -> tuple[Row[Number], Row[Number], Row[Number]]:
    """The three rows of the rotation matrix of the unit quaternion x, y, z (vector part), w (real part).

    The numbers may be arrays or tensors of one shape; each entry then is one too.
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


# Whether plain numbers are a similarity transform. Torch-free: checked before the work begins.

Rows = list[list[float]]
TOLERANCE = 1e-4
"""Largest Frobenius norm of M^T M / s^2 - I. ``Sim3.from_matrix`` accepts whatever passes here."""
_MIN_SCALE = 1e-6
_MAX_NUMBER = 1e9


def similarity_fault(rows: Any) -> str | None:
    """Why a row-major 4x4 is not x -> s R x + t with s > 0 and R a rotation; None when it is."""
    if not _is_four_by_four(rows):
        return "not four rows of four numbers"
    if not all(abs(number) <= _MAX_NUMBER for row in rows for number in row):
        return f"a number is not finite, or larger than {_MAX_NUMBER:g}"
    if list(rows[3]) != [0, 0, 0, 1]:
        transposed = [row[3] for row in rows] == [0, 0, 0, 1]
        return "the last row is not 0 0 0 1" + (", but the last column is: is it transposed?" if transposed else "")
    x, y, z = ([float(row[column]) for row in rows[:3]] for column in range(3))
    squared = (dot(x, x) + dot(y, y) + dot(z, z)) / 3
    if squared < _MIN_SCALE**2:
        return "the scale vanishes"
    lengths = sum((dot(axis, axis) / squared - 1) ** 2 for axis in (x, y, z))
    angles = sum((dot(a, b) / squared) ** 2 for a, b in ((x, y), (y, z), (z, x)))
    if not math.sqrt(lengths + 2 * angles) <= TOLERANCE:
        return "the axes are sheared, or have different lengths"
    if dot(cross(x, y), z) < 0:
        return "it is a reflection"
    return None


def inverse_rows(rows: Rows) -> Rows:
    """The inverse of a similarity's 4x4: (s R)^T / s^2 and what takes the translation back."""
    scale_squared = sum(float(value) ** 2 for row in rows[:3] for value in row[:3]) / 3
    turned = [[float(rows[j][i]) / scale_squared for j in range(3)] for i in range(3)]
    back = [-dot(row, [float(each[3]) for each in rows[:3]]) + 0.0 for row in turned]
    return [*([*row, t] for row, t in zip(turned, back, strict=True)), [0.0, 0.0, 0.0, 1.0]]


def transform_rows(value: Any) -> Rows:
    """The 4x4 T_object_scene in what people write: rows, an object with a ``matrix``, or a document with either under
    the name T_object_scene, or with the inverse under T_scene_object. Raises ValueError."""
    inverse = isinstance(value, Mapping) and "T_object_scene" not in value and "T_scene_object" in value
    if isinstance(value, Mapping):
        value = value["T_scene_object"] if inverse else value.get("T_object_scene", value)
    rows: Any = value.get("matrix") if isinstance(value, Mapping) else value
    fault = "there is no T_object_scene with a matrix" if rows is None else similarity_fault(rows)
    if fault:
        raise ValueError(fault)
    plain = [[float(number) for number in row] for row in rows]
    return inverse_rows(plain) if inverse else plain


def _is_four_by_four(rows: Any) -> bool:
    return (
        isinstance(rows, Sequence)
        and len(rows) == 4
        and all(isinstance(row, Sequence) and len(row) == 4 for row in rows)
        and all(isinstance(number, int | float) and not isinstance(number, bool) for row in rows for number in row)
    )
