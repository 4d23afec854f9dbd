"""Which surface faces the outside. Fields learned from images have cavities inside matter that do not exist."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

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
        labels, count = ndimage.label(self.free.numpy())
        border = np.zeros(count + 1, dtype=bool)
        for axis in range(3):
            for side in (0, -1):
                border[np.unique(np.take(labels, side, axis=axis))] = True
        border[0] = False
        grown: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = ndimage.binary_dilation(border[labels])
        return grown
