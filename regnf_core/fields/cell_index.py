"""Which cells of an endless lattice are occupied, and which occupied cells are nearest to any other."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from regnf_core.errors import FieldFormatError

_FARTHEST = 1 << 20
"""Cells lie less far from cell (0, 0, 0) along each axis, so that a cell of their box has a number below 2^63."""
_TABLE_CELLS = 1 << 18
_NEIGHBORS = 4


@dataclass(frozen=True)
class CellIndex:
    """Finds the rows of occupied cells. Its memory follows the number of cells, not the space between them.

    low, size: (3,) int64, the box round the cells · keys: (N,), the cells' numbers within it, ascending · rows: (N,),
    the row of each · table: (A, B, C, K), for each ``step``^3 cells of the box the rows of the K occupied cells that
    are nearest to their middle.
    """

    low: Tensor
    size: Tensor
    keys: Tensor
    rows: Tensor
    table: Tensor
    step: int

    @classmethod
    def of(cls, cells: Tensor) -> CellIndex:
        """The index of cells (N, 3), whole numbers; row i is cell i.

        Raises FieldFormatError (FIELD_INDEX_INVALID) for none, for one that occurs twice and for one too far away.
        """
        cells = cells.long()
        if cells.shape[0] == 0 or int(cells.max()) >= _FARTHEST or int(cells.min()) <= -_FARTHEST:
            raise _invalid("there are no cells, or one is too far from the origin")
        low, high = cells.amin(0), cells.amax(0)
        size = high - low + 1
        keys, rows = _number(cells - low, size).sort()
        if bool((keys.diff() == 0).any()):
            raise _invalid("a cell occurs twice")
        step = _step([int(extent) for extent in size])
        return cls(low, size, keys, rows, _nearest_rows(cells, low, size, step).to(cells.device), step)

    def to(self, device: torch.device | str) -> CellIndex:
        """The same index on another device."""
        moved = {name: getattr(self, name).to(device) for name in ("low", "size", "keys", "rows", "table")}
        return replace(self, **moved)

    def find(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Of cells (..., 3) the row, and whether there is one; the row means nothing where there is none."""
        offset = cells - self.low
        inside = ((offset >= 0) & (offset < self.size)).all(-1)
        number = torch.where(inside, _number(offset, self.size), 0)
        place = torch.searchsorted(self.keys, number).clamp_max(self.keys.shape[0] - 1)
        return self.rows[place], inside & (self.keys[place] == number)

    def nearest(self, cells: Tensor) -> Tensor:
        """The rows (..., K) of K occupied cells near each cell (..., 3): four, or all where there are fewer."""
        offset = torch.minimum((cells - self.low).clamp_min(0), self.size - 1) // self.step
        return self.table[offset[..., 0], offset[..., 1], offset[..., 2]]


def _number(offset: Tensor, size: Tensor) -> Tensor:
    return (offset[..., 0] * size[1] + offset[..., 1]) * size[2] + offset[..., 2]


def _step(size: list[int]) -> int:
    """The least edge of the table's cells that keeps the table small."""
    step = 1
    while math.prod(math.ceil(extent / step) for extent in size) > _TABLE_CELLS:
        step += max(1, step // 4)
    return step


def _nearest_rows(cells: Tensor, low: Tensor, size: Tensor, step: int) -> Tensor:
    """The table: for the middle of every ``step``^3 cells of the box the rows of the nearest of ``cells`` (N, 3)."""
    axes = [torch.arange(math.ceil(int(extent) / step), dtype=torch.float64) for extent in size]
    middles = low.cpu() + step * torch.cartesian_prod(*axes) + (step - 1) / 2.0
    count = min(_NEIGHBORS, cells.shape[0])
    _, rows = cKDTree(cells.cpu().numpy()).query(middles.numpy(), k=range(1, count + 1))
    return torch.from_numpy(rows).view(*[len(axis) for axis in axes], count)


def _invalid(message: str) -> FieldFormatError:
    return FieldFormatError(message, reason="FIELD_INDEX_INVALID")
