"""How far a ray may go without asking the field: lower bounds of the distance in the cells of a grid.

Cells near the surface are halved, and those too far from it for their size are not: the field is asked at few places.
It takes the part of an occupancy grid, and says of empty cells how empty they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.surface.sphere_tracing import finite_distance

_COARSEST, _LEVELS = 16, 3
"""Cells along the longest edge, and how often they are halved: 64 at the end."""
_TRUSTED = 0.85
"""Share of a distance that is believed: neural fields overstate distances far from surfaces."""
_LEAST = 0.2
"""Of a cell's edge: smaller bounds save no step."""
_AT_ONCE = 1 << 17


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """low: (3,), the bounds' lowest corner · cell: edge · bound: (X, Y, Z), never above the distance to a surface
    anywhere in the cell, 0 where one may be in it, and in matter."""

    low: Tensor
    cell: float
    bound: Tensor

    @classmethod
    def of(cls, field: SdfField) -> DistanceGrid:
        """On the field's device. Raises InvalidInputError (FIELD_NOT_FINITE)."""
        low, high = (corner.float().to(field.device) for corner in field.bounds)
        coarse = float((high - low).max()) / _COARSEST
        counts = torch.ceil((high - low) / coarse - 1e-6).long().clamp_min(1)
        size = [int(n) << (_LEVELS - 1) for n in counts.tolist()]
        bound = torch.zeros(size, device=low.device)
        cells = torch.cartesian_prod(*(torch.arange(int(n), device=low.device) for n in counts))
        for level in range(_LEVELS):
            cell = coarse / (1 << level)
            distance = torch.cat(
                [finite_distance(field, low + cell * (part + 0.5)) for part in torch.split(cells, _AT_ONCE)]
            )
            cls._enter(bound, cells, distance, cell, _LEVELS - 1 - level)
            near = distance.abs() * _TRUSTED <= 0.5 * 3**0.5 * cell
            children = torch.cartesian_prod(*(torch.arange(2, device=low.device),) * 3)
            cells = (2 * cells[near, None] + children).reshape(-1, 3)
        return cls(low, coarse / (1 << (_LEVELS - 1)), bound)

    @staticmethod
    def _enter(bound: Tensor, cells: Tensor, distance: Tensor, cell: float, finer: int) -> None:
        """Write what cells (C, 3) of a level with these distances (C,) at their middles say of the finest ones."""
        free = distance * _TRUSTED > 0.5 * 3**0.5 * cell
        parts = 1 << finer
        within = torch.cartesian_prod(*(torch.arange(parts, device=cells.device),) * 3)
        # from the cell's middle to the farthest corner of each finest cell
        offset = ((within + 0.5) / parts - 0.5).abs() + 0.5 / parts
        reach = cell * offset.norm(dim=-1)
        index = (cells[free, None] * parts + within).reshape(-1, 3)
        x, y, z = index.unbind(-1)
        found = (distance[free, None] * _TRUSTED - reach).reshape(-1)
        bound[x, y, z] = torch.where(found >= _LEAST * cell / parts, found, 0.0)

    def at(self, points: Tensor) -> Tensor:
        """(N,): the bound at points (N, 3); 0 outside of the grid."""
        index = ((points - self.low) / self.cell).floor().long()
        size = torch.tensor(self.bound.shape, device=points.device)
        within = ((index >= 0) & (index < size)).all(-1)
        x, y, z = index.clamp_min(0).minimum(size - 1).unbind(-1)
        return torch.where(within, self.bound[x, y, z], 0.0)
