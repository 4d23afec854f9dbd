"""Whether plain numbers are a similarity transform. Torch-free: checked before the work begins."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

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
    squared = (_dot(x, x) + _dot(y, y) + _dot(z, z)) / 3
    if squared < _MIN_SCALE**2:
        return "the scale vanishes"
    lengths = sum((_dot(axis, axis) / squared - 1) ** 2 for axis in (x, y, z))
    angles = sum((_dot(a, b) / squared) ** 2 for a, b in ((x, y), (y, z), (z, x)))
    if not math.sqrt(lengths + 2 * angles) <= TOLERANCE:
        return "the axes are sheared or stretched differently"
    if _dot(_cross(x, y), z) < 0:
        return "it mirrors space"
    return None


def inverse_rows(rows: Rows) -> Rows:
    """The inverse of a similarity's 4x4: (s R)^T / s^2 and what takes the translation back."""
    scale_squared = sum(float(value) ** 2 for row in rows[:3] for value in row[:3]) / 3
    turned = [[float(rows[j][i]) / scale_squared for j in range(3)] for i in range(3)]
    back = [-_dot(row, [float(each[3]) for each in rows[:3]]) + 0.0 for row in turned]
    return [*([*row, t] for row, t in zip(turned, back, strict=True)), [0.0, 0.0, 0.0, 1.0]]


def transform_rows(value: Any) -> Rows:
    """The 4x4 T_object_scene in what people write: rows, an object with a ``matrix``, or a document with either under
    the name T_object_scene, or with the inverse under T_scene_object. Raises ValueError."""
    inverse = isinstance(value, Mapping) and "T_object_scene" not in value and "T_scene_object" in value
    if isinstance(value, Mapping):
        value = value["T_scene_object"] if inverse else value.get("T_object_scene", value)
    rows: Any = value.get("matrix") if isinstance(value, Mapping) else value
    fault = "no T_object_scene with a matrix" if rows is None else similarity_fault(rows)
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


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(p * q for p, q in zip(a, b, strict=True))


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
