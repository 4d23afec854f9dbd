"""Similarities between a field's frame and its dataset's, as 4 x 4 rows of plain numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Rows = list[list[float]]
_TOLERANCE = 1e-4


def scaled_and_moved(scale: float, center: Sequence[float]) -> Rows:
    """x -> scale x + center."""
    rows = np.diag([scale, scale, scale, 1.0])
    rows[:3, 3] = center
    return _rows(rows)


def inverse_of(rows: Sequence[Sequence[float]], scale: float) -> Rows | None:
    """The inverse of x -> scale (R x + t) for ``rows`` of [R | t], 3 x 4; None where R is no rotation."""
    forward = np.eye(4)
    forward[:3] = np.array(rows, dtype=np.float64)
    forward[:3] *= scale
    return _inverse(forward) if is_similarity(forward) else None


def is_similarity(rows: Sequence[Sequence[float]] | np.ndarray) -> bool:
    """Whether the 4 x 4 rows are a rotation times one positive factor, and a shift."""
    matrix = np.array(rows, dtype=np.float64)
    linear = matrix[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    if not (np.isfinite(matrix).all() and 1e-9 < scale < 1e9 and tuple(matrix[3]) == (0.0, 0.0, 0.0, 1.0)):
        return False
    if np.abs(linear).max() > 2.0 * scale:  # and its square may be more than a float can be
        return False
    return bool(np.allclose(linear @ linear.T, scale**2 * np.eye(3), rtol=0, atol=_TOLERANCE * scale**2))


def after_scaling(rows: Sequence[Sequence[float]], factor: float) -> Rows:
    """The similarity that first multiplies by ``factor``."""
    matrix = np.array(rows, dtype=np.float64)
    matrix[:3, :3] *= factor
    return _rows(matrix)


def _inverse(matrix: np.ndarray) -> Rows:
    """Of a similarity; exactly one too, whatever the rounding of a general inverse."""
    linear = matrix[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    back = np.eye(4)
    back[:3, :3] = linear.T / scale**2
    back[:3, 3] = -back[:3, :3] @ matrix[:3, 3]
    return _rows(back)


def _rows(matrix: np.ndarray) -> Rows:
    return [[float(value) for value in row] for row in matrix]
