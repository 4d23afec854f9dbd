"""How long the distance to triangles takes: quick only where few boxes are as near as the nearest."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.work.calls import Calls

_LOOK_S, _STEP_S, _BUILD_S = 3e-7, 2e-6, 4e-6
"""Seconds: a triangle that is looked at, a level of the hierarchy, a triangle's place in it."""
_POINTS = 32
_MOST = 200_000
"""Of so many triangles the boxes are compared; of more, a random part."""


def mesh_work(tensors: Mapping[str, StoredArray], calls: Calls) -> float:
    """Seconds that the field's evaluation takes on one core: from the boxes that random points look into."""
    vertices, faces = np.asarray(tensors["vertices"], dtype=np.float64), np.asarray(tensors["faces"])
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        return 0.0  # no mesh: refused before it is evaluated
    random = np.random.default_rng(0)
    chosen = faces if len(faces) <= _MOST else faces[random.choice(len(faces), _MOST, replace=False)]
    corners = vertices[chosen]  # (T, 3, 3)
    low, high = corners.min(axis=1), corners.max(axis=1)
    lowest, highest = low.min(axis=0), high.max(axis=0)
    points = lowest + (highest - lowest) * random.random((_POINTS, 3))
    looked = np.mean([_as_near(point, corners, low, high) for point in points]) * len(faces) / len(chosen)
    per_point = float(looked) * _LOOK_S + math.log2(len(faces) + 1) * _STEP_S
    points_asked = sum(calls.values) + sum(calls.gradients)  # the gradient comes with the distance
    return len(faces) * _BUILD_S + points_asked * per_point


def _as_near(
    point: npt.NDArray[np.float64],
    corners: npt.NDArray[np.float64],
    low: npt.NDArray[np.float64],
    high: npt.NDArray[np.float64],
) -> int:
    """How many boxes are as near to the point as the nearest corner, so that none of them can be left out."""
    reach = np.square(corners[:, 0] - point).sum(axis=1).min()
    outside = np.maximum(np.maximum(low - point, point - high), 0.0)
    return int(np.count_nonzero(np.square(outside).sum(axis=1) <= reach))
