"""Numbers and matrices out of a dataset's JSON, checked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError

_RIGID_TOLERANCE = 1e-3
"""Of rotations and scales: files are often written with few digits."""


_LARGEST = 1e9
"""Larger numbers are neither places nor pixels, and their products overflow."""


def array(value: Any, shapes: tuple[tuple[int, ...], ...], what: str, reason: str) -> NDArray[np.float64]:
    """``value`` as float64 numbers of one of the shapes, finite and up to 1e9.

    Raises DatasetError with the given reason.
    """
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if numbers.shape not in shapes or not (np.abs(numbers) <= _LARGEST).all():  # NaN is not either
        wanted = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
        raise DatasetError(f"{what} is not {wanted} finite numbers, none beyond {_LARGEST:g}", reason=reason)
    return numbers


def matrix4(value: Any, what: str, reason: str) -> NDArray[np.float64]:
    """An affine (4, 4) matrix; the last row may be left out."""
    given = array(value, ((4, 4), (3, 4)), what, reason)
    matrix = np.eye(4)
    matrix[: len(given)] = given
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-9):
        raise DatasetError(f"{what} is not an affine transform: its last row is not 0 0 0 1", reason=reason)
    return matrix


def rigid(value: Any, what: str, reason: str) -> NDArray[np.float64]:
    """A rotation and a translation, (4, 4)."""
    matrix = matrix4(value, what, reason)
    rotation = matrix[:3, :3]
    straight = np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID_TOLERANCE)
    if not straight or np.linalg.det(rotation) < 0.0:
        raise DatasetError(f"{what} is not a rotation and a translation", reason=reason)
    return matrix


def similarity(value: Any, what: str, reason: str) -> NDArray[np.float64]:
    """A rotation, one positive scale and a translation, (4, 4)."""
    matrix = matrix4(value, what, reason)
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if determinant <= 0.0:
        raise DatasetError(f"{what} is not a similarity: its determinant is not positive", reason=reason)
    rotation = matrix[:3, :3] / np.cbrt(determinant)
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID_TOLERANCE):
        raise DatasetError(f"{what} is not a similarity: it shears or scales unevenly", reason=reason)
    return matrix


def whole_number(value: Any, what: str, reason: str) -> int:
    """A positive whole number."""
    whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if isinstance(value, bool) or not whole:
        raise DatasetError(f"{what} is not a whole number", reason=reason)
    if value < 1:
        raise DatasetError(f"{what} is not positive", reason=reason)
    return int(value)
