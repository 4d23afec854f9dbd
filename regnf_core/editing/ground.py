"""The surface of a support, as heights above its plane: as the scene has it, and continued where a thing stood."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve
from torch import Tensor

from regnf_core.editing.support import SupportPlane
from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox

Mask = NDArray[np.bool_]
Heights = NDArray[np.float64]
_ALONG = 64
"""Cells along the longer side of the box's footprint."""
_TOLERANCE = 0.02
"""Of the box's diagonal: heights beyond it are no longer the support's."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights over a plane in a rectangle round a box's footprint.

    origin: (3,), the middle of the first cell, on the plane · axes: (2, 3) unit, within it · cell: edge · heights:
    (A, B) float32 · missing: (A, B) distance to where the support goes on, 0 or less there; scene units.
    """

    plane: SupportPlane
    origin: Tensor
    axes: Tensor
    cell: float
    heights: Tensor
    missing: Tensor

    def distance(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(N,) of points (N, 3) to the support's matter, about, and the gradient (N, 3)."""
        at = (points - self.origin.to(points)) @ self.axes.to(points).T / self.cell
        height, slope = _sampled(self.heights, at)
        missing, away = _sampled(self.missing, at)
        above = self.plane.height(points) - height
        gradient = self.plane.normal.to(points) - (slope / self.cell) @ self.axes.to(points)
        beside = missing > above
        gradient = torch.where(beside[:, None], (away / self.cell) @ self.axes.to(points), gradient)
        return torch.maximum(above, missing), gradient


def ground_of(
    scene: SdfField, plane: SupportPlane, box: OrientedBox, belongs: Callable[[Tensor], Tensor] | None
) -> Ground | None:
    """The support in and round ``box``; None where the scene has nothing of it there.

    belongs: tells of points (N, 3) whether they are of the thing, or so near to it that the surface there may be its
    own; None: that is not known. Heights are known where the scene's surface is near the plane, nothing stands on it,
    and it is not the thing's; between, they solve Laplace's equation: a membrane fixed at what is known. A place that
    is free at the plane, and not enclosed by known ones, has no support: a table's top ends.
    """
    origin, axes, cell, counts = _rectangle(plane, box)
    index = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64) for n in counts))
    points = (origin + cell * index @ axes).float()
    distance = scene.signed_distance(points.to(scene.device)).double().cpu().numpy().reshape(counts)
    low, high = scene.bounds
    outside = ~((points >= low) & (points <= high)).all(-1).numpy().reshape(counts)
    own = np.zeros(counts, bool) if belongs is None else belongs(points).cpu().numpy().reshape(counts)
    tolerance = max(_TOLERANCE * box.diagonal, 4.0 * plane.roughness)
    above = (points + 1.5 * tolerance * plane.normal.float()).to(scene.device)
    bare = (scene.signed_distance(above) >= 0.75 * tolerance).cpu().numpy().reshape(counts)
    known = (np.abs(distance) <= tolerance) & bare & ~own & ~outside
    if known.sum() < 0.02 * known.size:
        return None
    free = (distance > tolerance) & ~own
    there = binary_fill_holes(~free) & ~outside
    heights = _membrane(np.where(known, -distance, 0.0), known)
    missing = np.full(counts, -1e3 * cell) if there.all() else _signed(there, cell)
    tensors = (torch.from_numpy(values.astype(np.float32)) for values in (heights, missing))
    return Ground(plane, origin, axes, cell, *tensors)


def _rectangle(plane: SupportPlane, box: OrientedBox) -> tuple[Tensor, Tensor, float, tuple[int, int]]:
    """Origin (3,), axes (2, 3), cell and counts of a grid on the plane that covers the box seen along its normal."""
    n = plane.normal
    along = box.rotation[:, int((box.rotation.T @ n).abs().argmin())]
    first = torch.nn.functional.normalize(along - (along @ n) * n, dim=0)
    axes = torch.stack([first, torch.linalg.cross(n, first)])
    corners = box.corners() @ axes.T
    low, high = corners.amin(0), corners.amax(0)
    cell = float((high - low).max()) / (_ALONG - 4)
    low, high = low - 2 * cell, high + 2 * cell
    a, b = (int(count) + 1 for count in ((high - low) / cell).ceil().tolist())
    return plane.offset * n + low @ axes, axes, cell, (a, b)


def _signed(there: Mask, cell: float) -> Heights:
    signed: Heights = (distance_transform_edt(~there) - distance_transform_edt(there)) * cell
    return signed - 0.5 * cell * np.sign(signed)


def _membrane(values: Heights, known: Mask) -> Heights:
    """Values (A, B) where known; elsewhere each is the mean of its neighbors."""
    number = np.full(values.shape, -1)
    unknown = ~known
    number[unknown] = np.arange(int(unknown.sum()))
    if not unknown.any():
        return values
    rows, columns, weights = [], [], []
    right = np.zeros(int(unknown.sum()))
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        inside = np.ones(values.shape, bool)
        inside[(slice(None),) * axis + ((-1 if step == 1 else 0),)] = False
        here = unknown & inside
        there = np.roll(number, -step, axis)[here]
        me = number[here]
        between = there >= 0
        rows += [me, me[between]]
        columns += [me, there[between]]
        weights += [np.ones(len(me)), -np.ones(int(between.sum()))]
        np.add.at(right, me[~between], np.roll(values, -step, axis)[here][~between])
    entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    matrix = coo_matrix(entries, shape=(len(right), len(right))).tocsr()
    solved = values.copy()
    solved[unknown] = spsolve(matrix, right)
    return solved


def _sampled(values: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Bilinear values (N,) at places (N, 2) in cells, and their slopes (N, 2) a cell; constant beyond the grid."""
    values = values.to(at.device)
    most = torch.tensor(values.shape, device=at.device) - 1
    within = at.clamp_min(0.0).minimum(most.to(at))
    low = within.floor().long().minimum(most - 1)
    x, y = low.unbind(-1)
    u, v = (within - low).unbind(-1)
    a, b, c, d = values[x, y], values[x + 1, y], values[x, y + 1], values[x + 1, y + 1]
    value = (1 - u) * (1 - v) * a + u * (1 - v) * b + (1 - u) * v * c + u * v * d
    slope = torch.stack([(1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)], dim=-1)
    return value, slope
