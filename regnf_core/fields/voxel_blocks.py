"""A field known in blocks of voxels where something was seen, interpolated between the voxels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.fields.cell_index import CellIndex
from regnf_core.fields.function_field import FunctionField
from regnf_core.fields.trilinear import (
    corner_offsets,
    interpolate,
    interpolate_colors,
    interpolate_with_derivative,
)
from regnf_core.schema.kinds.voxel_blocks import VoxelBlocksDescription


@dataclass(frozen=True)
class VoxelBlocksFunction:
    """Trilinear interpolation on an endless lattice of nodes; node q is at origin + voxel_size q.

    A node in a block has the block's value. Any other has the least that a block nearby allows: the value of the
    block's nearest node plus the distance to it. So the function is continuous and finite everywhere, its slope about 1
    where the blocks' is, and what no block covers is free space.
    values: (B, R, R, R) float32 or float16, first axis x · blocks: (B, 3), node R b is the block's first ·
    outward: -1 where values are negative in free space.
    """

    values: Tensor
    blocks: Tensor
    index: CellIndex
    origin: Tensor
    voxel_size: float
    outward: float
    colors: Tensor | None = None
    """(B, R, R, R, 3); a node with a negative number has none."""

    @property
    def device(self) -> torch.device:
        """Where the values live."""
        return self.values.device

    def to(self, device: torch.device | str) -> VoxelBlocksFunction:
        """The same function with its values on another device."""
        return replace(
            self,
            values=self.values.to(device),
            blocks=self.blocks.to(device),
            index=self.index.to(device),
            origin=self.origin.to(device),
            colors=None if self.colors is None else self.colors.to(device),
        )

    @property
    def has_color(self) -> bool:
        """Whether :meth:`color` may be asked."""
        return self.colors is not None

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color (N, 3) at points (N, 3), trilinear between the nodes that have one; black where none has.

        A node of no block has the color of the nearest node of the blocks nearby.
        """
        del directions
        assert self.colors is not None
        nodes, weights = self._cells(points)
        return interpolate_colors(self.colors.view(-1, 3)[self._nearest_numbers(nodes)], weights)

    def value(self, points: Tensor) -> Tensor:
        """Value (N,) at points (N, 3)."""
        return interpolate(*self._corners(points))

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Value (N,) at points (N, 3) and its gradient (N, 3); on a cell's border, that of the cell beyond."""
        value, derivative = interpolate_with_derivative(*self._corners(points))
        return value, derivative.T / self.voxel_size

    def _corners(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The values (2, 2, 2, N) at the corners of the points' cells, and the weights (3, N) of the upper ones."""
        nodes, weights = self._cells(points)
        return self._node_values(nodes).view(2, 2, 2, -1), weights

    def _cells(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The corners (8, N, 3) of the points' cells as nodes, and the weights (3, N) of the upper ones."""
        position = (points - self.origin) / self.voxel_size
        cell = position.floor()
        return cell.long() + corner_offsets(self.device)[:, None], (position - cell).T

    def _node_values(self, nodes: Tensor) -> Tensor:
        """The values (M, N) of nodes (M, N, 3)."""
        block = torch.div(nodes, self.values.shape[1], rounding_mode="floor")
        row, found = self.index.find(block)
        value = self._from_block(nodes, row)
        missing = nodes[~found]
        if missing.shape[0]:
            allowed = self._from_block(missing[:, None], self.index.nearest(block[~found]))  # (U, K)
            value[~found] = self.outward * (self.outward * allowed).amin(-1)
        return value

    def _from_block(self, nodes: Tensor, row: Tensor) -> Tensor:
        """What the blocks ``row`` (...) say of nodes (..., 3): a value, and the distance to where they have it."""
        edge = self.values.shape[1]
        local = nodes - edge * self.blocks[row]
        inside = local.clamp(0, edge - 1)
        value = self.values.view(-1)[_number(row, inside, edge)].float()
        away: Tensor = (local - inside).to(value.dtype).norm(dim=-1)
        return value + self.outward * self.voxel_size * away

    def _nearest_numbers(self, nodes: Tensor) -> Tensor:
        """Where in all blocks' nodes, one after another, those are that are nearest to nodes (M, N, 3): (M, N)."""
        edge = self.values.shape[1]
        block = torch.div(nodes, edge, rounding_mode="floor")
        row, found = self.index.find(block)
        missing = nodes[~found]
        if missing.shape[0]:
            near = self.index.nearest(block[~found])  # (U, K)
            local = missing[:, None] - edge * self.blocks[near]
            away = (local - local.clamp(0, edge - 1)).float().norm(dim=-1)
            row[~found] = near.gather(1, away.argmin(dim=1, keepdim=True))[:, 0]
        return _number(row, (nodes - edge * self.blocks[row]).clamp(0, edge - 1), edge)


def _number(row: Tensor, local: Tensor, edge: int) -> Tensor:
    """Of nodes (..., 3) of the blocks ``row`` (...), among the nodes of all blocks."""
    x, y, z = local.unbind(-1)
    return ((row * edge + x) * edge + y) * edge + z


def build_voxel_blocks(
    description: VoxelBlocksDescription, tensors: Mapping[str, Tensor], colors: Tensor | None = None
) -> FunctionField[VoxelBlocksFunction]:
    """The field of ``description`` with its values in ``tensors``. colors: (B, R, R, R, 3) of the nodes.

    The values keep their device and type; the tensors must have passed :meth:`VoxelBlocksDescription.check_tensors`.
    Raises FieldFormatError (FIELD_INDEX_INVALID).
    """
    values, blocks = tensors["values"].contiguous(), tensors["blocks"].long()
    origin = torch.tensor(description.origin, dtype=torch.float32, device=values.device)
    function = VoxelBlocksFunction(
        values,
        blocks,
        CellIndex.of(blocks),
        origin,
        description.voxel_size,
        float(description.sign),
        None if colors is None else colors.contiguous(),
    )
    return FunctionField(function, torch.tensor(description.function_bounds, dtype=torch.float64))
