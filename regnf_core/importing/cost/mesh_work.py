"""How long the distance to triangles takes: quick only where few of them are so near that they must be looked at."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.importing.cost.calls import Calls

_LOOK_S, _STEP_S, _BUILD_S = 3e-7, 2e-6, 4e-6
"""Seconds: a triangle that is looked at, a level of the hierarchy, a triangle's place in it."""
_POINTS = 32
_MOST = 200_000
"""Of so many triangles the boxes are compared; of more, a random part."""
_FAR = 2.0
"""The winding number takes triangles together from so many of their radii on (Barill et al. 2018)."""
_Array = npt.NDArray[np.float64]


def mesh_work(vertices: npt.NDArray[Any], faces: npt.NDArray[Any], calls: Calls) -> float:
    """Seconds that the field's evaluation takes on one core. vertices: (V, 3) · faces: (F, 3)."""
    # The gradient comes with the distance, and is asked for at the surface.
    return mesh_seconds(vertices, faces, sum(calls.values), sum(calls.gradients))


def mesh_seconds(vertices: npt.NDArray[Any], faces: npt.NDArray[Any], points: int, near: int = 0) -> float:
    """Seconds for distance and winding number at so many points anywhere, and at so many near the surface.

    They are told by the triangles that random points look at. Near the surface that is the most of any: a knot of
    triangles in a large box is not seen from random places of the box, and all that walks to the surface ends in it.
    """
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        return 0.0  # no mesh: refused before it is evaluated
    random = np.random.default_rng(0)
    chosen = faces if len(faces) <= _MOST else faces[random.choice(len(faces), _MOST, replace=False)]
    corners = np.asarray(vertices, dtype=np.float64)[chosen]  # (T, 3, 3)
    low, high = corners.min(axis=1), corners.max(axis=1)
    middle = corners.mean(axis=1)
    far = _FAR**2 * np.square(corners - middle[:, None]).sum(axis=2).max(axis=1)
    lowest, highest = low.min(axis=0), high.max(axis=0)
    anywhere = lowest + (highest - lowest) * random.random((_POINTS, 3))
    looks = [_looked_at(probe, corners, (low, high), middle, far) for probe in anywhere]
    seconds = points * _seconds_each(sum(looks) / _POINTS / len(chosen), len(faces))
    if near:
        at_surface = middle[random.integers(len(chosen), size=_POINTS)]
        most = max(_looked_at(probe, corners, (low, high), middle, far) for probe in at_surface)
        seconds += near * _seconds_each(most / len(chosen), len(faces))
    return len(faces) * _BUILD_S + seconds


def _looked_at(probe: _Array, corners: _Array, boxes: tuple[_Array, _Array], middle: _Array, far: _Array) -> int:
    """How many triangles are looked at for one point, some of them twice."""
    low, high = boxes
    # None of the boxes that are as near as the nearest corner can be left out ...
    reach = np.square(corners[:, 0] - probe).sum(axis=1).min()
    outside = np.maximum(np.maximum(low - probe, probe - high), 0.0)
    looked = int(np.count_nonzero(np.square(outside).sum(axis=1) <= reach))
    # ... and of triangles that are not far the solid angle is computed one by one.
    return looked + int(np.count_nonzero(np.square(middle - probe).sum(axis=1) <= far))


def _seconds_each(share: float, faces: int) -> float:
    """Seconds of one point that looks at this share of the triangles."""
    return share * faces * _LOOK_S + math.log2(faces + 1) * _STEP_S
