"""What reaches into a thing's box without being of it: a table's top over a chair, a wall, a thing beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.ndimage import binary_dilation, label
from torch import Tensor

from regnf_core.editing.region import GridDistance, Mask, RegionGrid, box_distance
from regnf_core.editing.support import SupportPlane
from regnf_core.fields.base import SdfField
from regnf_core.fields.observation import observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.schema.observation_grid import SURFACE

_ALONG, _AROUND = 72, 1.3
"""Cells along the longest edge, and how much larger than the box their region is."""
_LEAST_CELLS = 24
_LEAST_OUTSIDE = 0.3
"""Share of a component outside of the box from which on it is a neighbor, where the box alone says what is removed."""
_KEPT_AROUND = 2
"""Cells round a neighbor's surface that are kept with it."""


def kept_neighbors(
    scene: SdfField, box: OrientedBox, planes: Sequence[SupportPlane], of_thing: Callable[[Tensor], Tensor] | None
) -> GridDistance | None:
    """The signed distance to what is kept in ``box``, negative there; None where nothing is.

    of_thing: tells of points (N, 3) whether they are near the thing's known surface; None: it is not known.
    The scene's matter is divided into connected components, without supports and without what is the thing's. Those
    that go on outside of the box are neighbors; the rest is taken for the thing's, or for noise. Where the scene knows
    what was observed, only what was measured counts: unobserved matter behind a thing is not kept.
    """
    around = OrientedBox(box.center, box.size * _AROUND, box.rotation)
    grid = RegionGrid.over(around, _ALONG)
    points = grid.points()
    distance = grid.cube(scene.signed_distance(points.to(scene.device)))
    matter = (distance < 0.25 * grid.cell) & (distance > -_KEPT_AROUND * 2 * grid.cell)
    thickness = 1.5 * grid.cell
    for plane in planes:
        matter &= grid.cube(plane.height(points)) > max(thickness, 4.0 * plane.roughness)
    if of_thing is not None:
        matter &= ~_mask(grid, of_thing(points))
    measured = _measured(scene, grid, points)
    if measured is not None:
        matter &= measured
    inside = _mask(grid, box_distance(box, points) < 0.0)
    kept = _going_out(matter, inside, 1e-9 if of_thing is not None else _LEAST_OUTSIDE)
    if not (kept & inside).any():
        return None
    return grid.distance_to(binary_dilation(kept, iterations=_KEPT_AROUND))


def _mask(grid: RegionGrid, values: Tensor) -> Mask:
    found: Mask = values.cpu().numpy().reshape(grid.shape)
    return found


def _measured(scene: SdfField, grid: RegionGrid, points: Tensor) -> Mask | None:
    """Cells near a place where a surface was measured; None where that is not known."""
    observation = observation_of(scene)
    if observation is None:
        return None
    near = _mask(grid, observation.at(points) == SURFACE)
    reach = max(1, round(observation.voxel / grid.cell))
    return np.asarray(binary_dilation(near, iterations=reach))


def _going_out(matter: Mask, inside: Mask, least_outside: float) -> Mask:
    """The components of ``matter`` of which at least this share lies outside of the box."""
    labels, count = label(matter, structure=np.ones((3, 3, 3)))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    outside = np.bincount(labels[~inside], minlength=count + 1)
    neighbor = (sizes >= _LEAST_CELLS) & (outside >= np.maximum(1, least_outside * sizes))
    neighbor[0] = False
    return np.asarray(neighbor[labels])


def near_thing(thing: SdfField, margin: float) -> Callable[[Tensor], Tensor]:
    """Tells of points (N, 3) whether they are in ``thing`` or nearer to it than ``margin``."""
    return lambda points: thing.signed_distance(points.to(thing.device)).to(points.device) < margin
