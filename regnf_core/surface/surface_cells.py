"""The cells of a region that the surface may pass through: an octree, subdivided only near the surface.

This takes a few thousand evaluations, where a dense grid of the same resolution takes tens of thousands. Thin parts are
found as well as broad ones, and the cells are spread evenly over the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

import numpy as np
import torch
from torch import Tensor

from regnf_core.geometry.bundle import Bundle

# Which surface faces the outside. Fields learned from images have cavities inside matter that do not exist.

_STEP = 1.5  # cells along the normal: beyond the surface's own cell, short of the far side of most gaps


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Which cells of a cubic grid are free. low: (3,) lowest corner · edge: of a cell · free: (X, Y, Z) bool."""

    low: Tensor
    edge: float
    free: Tensor

    def mark(self, centers: Tensor, block: int) -> None:
        """Mark the blocks of ``block`` cells an edge about ``centers`` (N, 3) as free, in place."""
        first = ((centers - self.low) / self.edge - block / 2).round().long()
        offsets = torch.cartesian_prod(*[torch.arange(block)] * 3).reshape(-1, 3)
        cells = (first[:, None] + offsets).reshape(-1, 3)
        self.free[cells[:, 0], cells[:, 1], cells[:, 2]] = True

    def faces_outside(self, points: Tensor, normals: Tensor) -> Tensor:
        """(N,) bool: which surface points (N, 3) face free space that is connected to the grid's border.

        True for all points when no free space reaches the border.
        """
        outer = self._connected_to_border()
        if not outer.any():
            return torch.ones(points.shape[0], dtype=torch.bool)
        ahead = points.double() + _STEP * self.edge * normals.double()
        cell = ((ahead - self.low) / self.edge).floor().long()
        size = torch.tensor(outer.shape)
        beyond = ((cell < 0) | (cell >= size)).any(-1)
        cell = torch.minimum(cell.clamp_min(0), size - 1)
        return beyond | torch.from_numpy(outer)[cell[:, 0], cell[:, 1], cell[:, 2]]

    def _connected_to_border(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Free cells connected to the border, and the cells beside them."""
        from scipy import ndimage

        labels, count = ndimage.label(self.free.numpy())
        border = np.zeros(count + 1, dtype=bool)
        for axis in range(3):
            for side in (0, -1):
                border[np.unique(np.take(labels, side, axis=axis))] = True
        border[0] = False
        grown: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = ndimage.binary_dilation(border[labels])
        return grown


_REACH = 1.15 * 0.5 * 3**0.5
"""Cells whose |value| is beyond this many edges hold no surface; neural fields overstate distances a little."""
_MAX_CROPS = 8
_THIN = 3.5
"""Edges: near both faces of a plate that is thinner than two edges lie no more cells."""
_MOST_FURTHER = 2
"""Subdivisions for small surface: what has less than a sixteenth of the samples is smaller than fields resolve."""


@dataclass(frozen=True, eq=False)
class Cells(Bundle):
    """Cubic cells: centers (N, 3) float64, the field's values there (N,), the edge; all in one frame and unit."""

    centers: Tensor
    values: Tensor
    edge: float

    def near(self) -> Cells:
        """The cells that may hold surface."""
        return self[self.values.abs() <= _REACH * self.edge]

    def halved(self, value: Callable[[Tensor], Tensor]) -> Cells:
        """The eight halves of each."""
        return _split(value, self)

    def few_or_thin(self, enough: int) -> bool:
        """Whether there are no more than ``enough`` cells, or the two faces of a thin object share them."""
        low, high = self.extent()
        return len(self.values) <= enough or float((high - low).min()) < _THIN * self.edge

    def extent(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest corner (3,) of all cells."""
        return self.centers.amin(0) - self.edge / 2, self.centers.amax(0) + self.edge / 2


def surface_cells(
    value: Callable[[Tensor], Tensor], low: Tensor, high: Tensor, base: int, levels: int, enough: int = 0
) -> tuple[Cells, FreeSpace]:
    """The cells along the surface within low..high (3,): ``base`` along the longest edge, subdivided ``levels`` times,
    and further while there are no more than ``enough`` or they are a thin layer.

    ``value`` gives the signed distance (N,) at points (N, 3). There may be no such cells. The second result is the free
    space that the values show, on a grid of the finest cells.
    """
    cells, coarse = _grid(value, low, high, base), []
    start, end = cells.extent()
    for level in count():
        coarse.append(cells.centers[cells.values > _REACH * cells.edge])
        near = cells.near()
        if level >= levels and (enough == 0 or level == levels + _MOST_FURTHER or not near.few_or_thin(enough)):
            break
        cells = _split(value, near)
    size = ((end - start) / cells.edge).round().long().tolist()
    space = FreeSpace(start, cells.edge, torch.zeros(size, dtype=torch.bool))
    for halved, centers in enumerate(reversed(coarse)):
        space.mark(centers, 2**halved)
    space.mark(cells.centers[cells.values > 0], 1)
    return near, space


def crop_to_surface(value: Callable[[Tensor], Tensor], low: Tensor, high: Tensor, base: int) -> tuple[Tensor, Tensor]:
    """Corners (3,), (3,) of the part of the region low..high that may hold surface, found on smaller and smaller grids.

    The region itself, when no cell is near the surface.
    """
    for _ in range(_MAX_CROPS):
        near = _grid(value, low, high, base).near()
        if near.centers.shape[0] == 0:
            break
        lowest, highest = near.extent()
        lowest, highest = torch.maximum(lowest, low), torch.minimum(highest, high)
        shrunk = float((highest - lowest).max() / (high - low).max())
        low, high = lowest, highest
        if shrunk > 0.75:
            break
    return low, high


def _grid(value: Callable[[Tensor], Tensor], low: Tensor, high: Tensor, base: int) -> Cells:
    edge = float((high - low).max()) / base
    counts = ((high - low) / edge - 1e-9).ceil().clamp_min(1).long()
    start = (low + high) / 2 - counts * edge / 2
    axes = [start[k] + (torch.arange(int(counts[k]), dtype=torch.float64) + 0.5) * edge for k in range(3)]
    centers = torch.cartesian_prod(*axes).reshape(-1, 3)
    return Cells(centers, value(centers), edge)


def _split(value: Callable[[Tensor], Tensor], cells: Cells) -> Cells:
    edge = cells.edge / 2
    offsets = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3) * edge  # (8, 3)
    centers = (cells.centers[:, None] + offsets).reshape(-1, 3)
    return Cells(centers, value(centers), edge)
