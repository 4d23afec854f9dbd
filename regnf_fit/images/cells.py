"""Cubic cells of space, and which points lie in which."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Cells(NamedTuple):
    """The cells that points lie in. of: (N,), each point's cell · counts: (C,), points in each."""

    of: Tensor
    counts: Tensor

    def means(self, values: Tensor) -> Tensor:
        """(C, F) float64: of the values (N, F) of each cell's points."""
        total = torch.zeros(len(self.counts), values.shape[1], dtype=torch.float64)
        return total.index_add_(0, self.of, values.double()) / self.counts[:, None]


def cells_of(points: Tensor, edge: float) -> Cells:
    """The cells of this edge that points (N, 3) lie in, N at least 1."""
    cell = (points.double() / edge).floor().long()
    cell = cell - cell.amin(0)
    across = cell.amax(0) + 1
    numbers = (cell[:, 0] * across[1] + cell[:, 1]) * across[2] + cell[:, 2]
    _, of, counts = torch.unique(numbers, return_inverse=True, return_counts=True)
    return Cells(of, counts)
