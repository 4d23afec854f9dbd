"""A detection's rotation: a 3x3 matrix, or a quaternion that says its order."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from regnf_core.detections.numbers import Place, fault, number, numbers, shown
from regnf_core.rotations import (
    IDENTITY,
    Quaternion,
    determinant,
    orthonormality_error,
    quaternion_of,
)

MAX_COMPONENT = 1e3
MAX_ORTHONORMALITY_ERROR = 1e-3
"""Largest entry of |R R^T - I|: matrices written with four digits pass."""
_MIN_NORM = 1e-6
_ROWS = "Write three rows of three numbers; the columns are the box's axes in the scene."


def read_quaternion(value: Any, place: Place, order: str) -> Quaternion:
    """A quaternion whose components come in ``order``, as x, y, z, w."""
    components = dict(zip(order, numbers(value, place, order, MAX_COMPONENT), strict=True))
    if math.hypot(*components.values()) < _MIN_NORM:
        raise fault(place, "is zero, expected a quaternion with a direction", "Leave it out for an upright box.")
    return components["x"], components["y"], components["z"], components["w"]


def read_rotation(value: Any, place: Place) -> Quaternion:
    """The quaternion (x, y, z, w) of `rotation`: three rows, or an object {x, y, z, w}."""
    if isinstance(value, Mapping):
        return read_quaternion(value, place, "xyzw")
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise fault(place, f"is {shown(value)}, expected a 3x3 matrix", _ROWS)
    if len(value) == 4 and not any(isinstance(part, Sequence) for part in value):
        raise _either_order(value, place)
    if len(value) != 3 or not all(isinstance(row, Sequence) and len(row) == 3 for row in value):
        raise fault(place, f"is {shown(value)}, expected a 3x3 matrix", _ROWS)
    rows = [[number(part, (*place, i, j), MAX_COMPONENT) for j, part in enumerate(row)] for i, row in enumerate(value)]
    _require_rotation(rows, place)
    identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    return IDENTITY if rows == identity else quaternion_of(rows)


def _either_order(value: Sequence[Any], place: Place) -> Exception:
    listed = ", ".join(f"{number(part, (*place, i), MAX_COMPONENT):g}" for i, part in enumerate(value))
    hint = (
        f"Write `rotation_quaternion_xyzw`: [{listed}] if the last number is w, "
        f"`rotation_quaternion_wxyz`: [{listed}] if the first one is."
    )
    return fault(place, f"is four numbers, [{listed}]: a quaternion of unknown order", hint)


def _require_rotation(rows: Sequence[Sequence[float]], place: Place) -> None:
    error = orthonormality_error(rows)
    if error > MAX_ORTHONORMALITY_ERROR:
        hint = "Its rows must be perpendicular and of length 1: keep the scale in `size`, and write more digits."
        raise fault(place, f"is no rotation: R R^T differs from the identity by {error:.2g}", hint)
    if determinant(rows) < 0:
        hint = "Negate one column: a box looks the same, and its axes are right-handed then."
        raise fault(place, "is a reflection, of determinant -1, expected a rotation, of determinant 1", hint)
