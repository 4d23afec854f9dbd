"""The observation of a cloud whose points were measured from known positions: a ray is free up to its point.

It is free up to the first voxel in which any surface was measured: where a position is wrong, less is said to be free.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from regnf_core.importing.meshes.triangle_files import Float64Array
from regnf_core.schema.description import FARTHEST, FREE, SURFACE, UNSEEN, ObservationGrid

_ALONG = 128
"""Voxels along the longest side of the points' box, at most."""
_SPACINGS = 2.0
"""Spacings of the points that a voxel is across at least: between rays farther apart it would be missed."""
_RAYS = 200_000
_STEP, _MARGIN = 0.5, 1.0
"""In voxels: between samples of a ray, and how far before its point it is no longer said to be free: points are noisy,
and voxels reach behind a surface."""
_HIDDEN, _DOUBTFUL = 5.0, 0.5
"""A point is hidden where its ray meets another surface so many voxels before it. With such a share of hidden points,
the positions are not those from which they were measured."""


def observed_by_rays(
    points: Float64Array, sensors: Float64Array, spacing: float
) -> tuple[ObservationGrid, npt.NDArray[np.int32]] | None:
    """The observation as a field file keeps it; None where it would lie too far from the origin, no position is known,
    or most points are hidden from theirs.

    points: (N, 3), in the coordinates of the kind's function · sensors: (N, 3), from where each was measured, NaN where
    that is not known · spacing: the usual distance between neighboring points.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    voxel = max(_SPACINGS * spacing, float((high - low).max()) / _ALONG)
    # The lowest points lie in the middle of voxels: a floor along the axes is in one layer of them.
    low, counts = low - 1.5 * voxel, np.floor((high - low) / voxel).astype(np.int64) + 4
    seen = np.flatnonzero(np.isfinite(sensors).all(axis=1))
    if len(seen) == 0 or max(np.abs(low).max(), np.abs(high).max()) > FARTHEST:
        return None
    states = np.full(int(counts.prod()), UNSEEN, np.uint8)
    states[_index((points - low) / voxel, counts)] = SURFACE
    if len(seen) > _RAYS:
        seen = seen[np.random.default_rng(0).permutation(len(seen))[:_RAYS]]
    starts, ends = ((places[seen] - low) / voxel for places in (sensors, points))
    if _walk(states, counts, starts, ends) > _DOUBTFUL:
        return None
    grid = ObservationGrid((float(low[0]), float(low[1]), float(low[2])), voxel, (*map(int, counts),))  # type: ignore[arg-type]
    return grid, grid.pack(states.reshape(counts))


def _walk(
    states: npt.NDArray[np.uint8], counts: npt.NDArray[np.int64], starts: Float64Array, ends: Float64Array
) -> float:
    """Mark as free what rays (N, 3) to (N, 3), in voxels, go through; the share of rays that end far too early."""
    along = ends - starts
    length = np.linalg.norm(along, axis=1)
    along /= length[:, None].clip(1e-12)
    with np.errstate(all="ignore"):  # a ray along an axis has no crossing with the others' planes
        crossings = np.stack([-starts / along, (counts - starts) / along])
    at = np.nanmin(crossings, axis=0).max(axis=1).clip(0.0) + _STEP
    rays = np.flatnonzero(at < length - _MARGIN)
    hidden = 0
    while len(rays):
        index = _index(starts[rays] + at[rays, None] * along[rays], counts)
        met = (states[index] == SURFACE) & (at[rays] > _MARGIN)
        hidden += int((length[rays[met]] - at[rays[met]] > _HIDDEN).sum())
        states[index[states[index] != SURFACE]] = FREE
        rays = rays[~met]
        at[rays] += _STEP
        rays = rays[at[rays] < length[rays] - _MARGIN]
    return hidden / len(length)


def _index(places: Float64Array, counts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The numbers (N,) of the voxels of places (N, 3), which lie within the grid but for rounding."""
    x, y, z = np.minimum(np.maximum(np.floor(places).astype(np.int64), 0), counts - 1).T
    index: npt.NDArray[np.int64] = (x * counts[1] + y) * counts[2] + z
    return index
