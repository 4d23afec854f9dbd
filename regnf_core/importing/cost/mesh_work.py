"""How long the distance to triangles takes: quick only where few of them are so near that they must be looked at."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import StoredArray
from regnf_core.schema.description import COLOR, FieldDescription, NetworkColor
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.kinds import NeuralPointsDescription

# How many points the importer evaluates a field at: the checks of plausibility, and the trials of several readings.

SAMPLES = 16_384
"""Points that a field is checked at."""
TRIAL_POINTS = 1_024
"""Points that each of several readings is tried at, with its gradient."""
MAX_TRIED, TRIED_MORE = 64, 32
"""The most usual readings, which are all tried; and those of the best grid over other cubes or beside other sines."""
FINAL_POINTS, FINALISTS = 8_192, 12
"""Points of the second round, and how many rivals may come into it."""
LAST_POINTS = 32_768
"""Points of the third round, in which the interpolation is told where the second one leaves it open."""
SHARES = (1, 2, 4, 8)
"""Of a field whose trials would take too long, all rounds but the first have a half, a quarter or an eighth of the
points."""
NEAREST_SHARE = 16
ASKED_AGAIN = 64
STEPS = 8
FACES, FACE_SHARE = 6, 64
COLOR_POINTS = 1 << 16
"""A color must be affordable at so many points: those of a small picture."""
GRADIENT = 3.0
"""A value with its gradient takes as long as so many values."""


@dataclass(frozen=True)
class Calls:
    """Points of every call for values, and of every call for values with gradients."""

    values: tuple[int, ...]
    gradients: tuple[int, ...]

    @property
    def points(self) -> float:
        """How many points' values would take as long."""
        return sum(self.values) + GRADIENT * sum(self.gradients)


def calls_of_check(samples: int) -> Calls:
    """What one check of plausibility evaluates."""
    nearest = samples // NEAREST_SHARE
    return Calls((samples, ASKED_AGAIN, FACES * (samples // FACE_SHARE)), (nearest,) * (STEPS + 1))


def calls_of_trials(readings: int, share: int = 1) -> Calls:
    """What the choice among so many readings evaluates at most; after the first round at one ``share``-th of the
    points."""
    first = (TRIAL_POINTS,) * (min(readings, MAX_TRIED + TRIED_MORE) + 2)
    final = (FINAL_POINTS,) * (2 * min(readings, FINALISTS) + 7)
    last = (LAST_POINTS,) * 2
    values = tuple(4 * points // share for points in (FINAL_POINTS, FINAL_POINTS, LAST_POINTS))
    gradients = tuple(points // share for points in final + last)
    return Calls((4 * TRIAL_POINTS, *values), first + gradients)


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
    # The gradient comes with the distance, and is requested at the surface.
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


# How long fields of layers, grids, blocks and points take: so much a point, from the shapes of their tensors.

_POINT_S, _CORNER_S, _CELL_S = 2e-6, 1.5e-8, 1e-7
"""Seconds: a point, a number read at a corner of a grid's cell, a cell that is looked up."""
_PRODUCT_S, _ACTIVATION_S = 1e-10, 1.5e-8
"""Seconds: a multiplication and addition of a layer, one of its outputs."""
_CORNERS = 8


def network_work(description: FieldDescription, tensors: Mapping[str, StoredArray], calls: Calls) -> float:
    """Seconds that the field's evaluation takes on one core, by a conservative rate."""
    layers: float = sum(_layer(array.shape) for name, array in tensors.items() if name.startswith("layers."))
    grid = getattr(description, "hash", None)
    if isinstance(grid, HashGridConfig):
        layers += grid.levels * grid.features_per_level * _CORNERS * _CORNER_S
    volumes: int = sum(array.shape[-1] for name, array in tensors.items() if name.startswith("volumes.") and array.ndim)
    layers += volumes * _CORNERS * _CORNER_S
    if isinstance(description, NeuralPointsDescription):
        decoded = 1 if description.blend_first else description.neighbors
        each = _POINT_S + decoded * layers + (2 * math.floor(description.reach) + 1) ** 3 * _CELL_S
        return each * GRADIENT * (sum(calls.values) + sum(calls.gradients))
    return (_POINT_S + layers) * calls.points


def color_work(color: NetworkColor, tensors: Mapping[str, StoredArray]) -> float:
    """Seconds that the network of a color takes at a point on one core, beside those of the geometry."""
    layers = sum(_layer(array.shape) for name, array in tensors.items() if name.startswith(f"{COLOR}.layers."))
    width = 0 if color.hash is None else color.hash.width
    return _POINT_S + layers + width * _CORNERS * _CORNER_S


def _layer(shape: tuple[int, ...]) -> float:
    """A weight of two axes is multiplied, a bias added, its result put through an activation."""
    return math.prod(shape) * _PRODUCT_S if len(shape) > 1 else math.prod(shape) * _ACTIVATION_S


# The limits on estimated work and memory.

_LIBRARIES = 3 << 29


def require_within(seconds: float, work_s: float) -> None:
    """Raise FieldFormatError (IMPORT_TOO_COSTLY) when more seconds are estimated than allowed."""
    if seconds > work_s:
        message = (
            f"the checks of the field would take an estimated {seconds:.0f} s of processor time; {work_s:g} s are "
            f"allowed"
        )
        raise FieldFormatError(message, reason="IMPORT_TOO_COSTLY")


def free_room(memory_bytes: int) -> int:
    """Bytes that libraries and upload leave of so many."""
    return max(memory_bytes - _LIBRARIES, memory_bytes // 2)


def require_room(needed: int, room: int) -> None:
    """Raise FieldFormatError (IMPORT_TOO_COSTLY) when more bytes are estimated than there are."""
    if needed > room:
        message = (
            f"the values of the field would need an estimated {needed >> 20} MiB of memory; {room >> 20} MiB are free"
        )
        raise FieldFormatError(message, reason="IMPORT_TOO_COSTLY")


# How fine a surface through points can be afforded: it takes time by the cells with points.

_CLOUD_CELL_S = 2.5e-4
"""Seconds for a cell of the octree with points in it: 0.1 to 0.29 ms, by spheres and noise of up to 300,000 points."""
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
    return len(np.unique((x << 2 * depth) + (y << depth) + z)) * _CLOUD_CELL_S
