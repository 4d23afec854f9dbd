"""How long the distance to triangles takes: quick only where few of them are so near that they must be looked at."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.importing.work.calls import Calls

_LOOK_S, _STEP_S, _BUILD_S = 3e-7, 2e-6, 4e-6
"""Seconds: a triangle that is looked at, a level of the hierarchy, a triangle's place in it."""
_POINTS = 32
_MOST = 200_000
"""Of so many triangles the boxes are compared; of more, a random part."""
_FAR = 2.0
"""The winding number takes triangles together from so many of their radii on (Barill et al. 2018)."""


def mesh_work(vertices: npt.NDArray[Any], faces: npt.NDArray[Any], calls: Calls) -> float:
    """Seconds that the field's evaluation takes on one core. vertices: (V, 3) · faces: (F, 3)."""
    # The gradient comes with the distance.
    return mesh_seconds(vertices, faces, sum(calls.values) + sum(calls.gradients))


def mesh_seconds(vertices: npt.NDArray[Any], faces: npt.NDArray[Any], points: int) -> float:
    """Seconds for distance and winding number at so many points: by the triangles that random points look at."""
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        return 0.0  # no mesh: refused before it is evaluated
    random = np.random.default_rng(0)
    chosen = faces if len(faces) <= _MOST else faces[random.choice(len(faces), _MOST, replace=False)]
    corners = np.asarray(vertices, dtype=np.float64)[chosen]  # (T, 3, 3)
    low, high = corners.min(axis=1), corners.max(axis=1)
    middle = corners.mean(axis=1)
    far = _FAR**2 * np.square(corners - middle[:, None]).sum(axis=2).max(axis=1)
    lowest, highest = low.min(axis=0), high.max(axis=0)
    looked = 0
    for probe in lowest + (highest - lowest) * random.random((_POINTS, 3)):
        # None of the boxes that are as near as the nearest corner can be left out ...
        reach = np.square(corners[:, 0] - probe).sum(axis=1).min()
        outside = np.maximum(np.maximum(low - probe, probe - high), 0.0)
        looked += int(np.count_nonzero(np.square(outside).sum(axis=1) <= reach))
        # ... and of triangles that are not far the solid angle is computed one by one.
        looked += int(np.count_nonzero(np.square(middle - probe).sum(axis=1) <= far))
    each = looked / _POINTS * len(faces) / len(chosen) * _LOOK_S + math.log2(len(faces) + 1) * _STEP_S
    return len(faces) * _BUILD_S + points * each
