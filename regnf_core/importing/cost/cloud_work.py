"""How fine a surface through points can be afforded: it takes time by the cells with points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from regnf_core.importing.cost.budget import require_within

_CELL_S = 2.5e-4
"""Seconds for a cell of the octree with points in it: .1 to .29 ms, by spheres and noise of up to 300,000 points."""
FINEST, _COARSEST = 8, 5
SPAN = 1.1
"""The octree's cube is so many times as wide as the points."""


def affordable_depth(points: npt.NDArray[np.float64], work_s: float) -> int:
    """Levels of the octree, FINEST where the estimate for these points (N, 3) is within ``work_s``, else fewer.

    Points of a surface that fill more cells than are affordable lie farther apart than the cells are wide: a coarser
    octree loses little of them. Raises FieldFormatError (IMPORT_TOO_COSTLY) where even the coarsest takes too long.
    """
    extent = float(np.ptp(points, axis=0).max())
    places = (points - points.min(axis=0)) / (extent * SPAN)
    for depth in range(FINEST, _COARSEST, -1):
        if _seconds(places, depth) <= work_s:
            return depth
    require_within(_seconds(places, _COARSEST), work_s)
    return _COARSEST


def _seconds(places: npt.NDArray[np.float64], depth: int) -> float:
    """places: (N, 3) within [0, 1)."""
    x, y, z = np.floor(places * 2**depth).astype(np.int64).T
    return len(np.unique((x << 2 * depth) + (y << depth) + z)) * _CELL_S
