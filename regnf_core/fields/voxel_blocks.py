"""A field known in blocks of voxels where something was seen, interpolated between the voxels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.fields.cell_index import CellIndex
from regnf_core.fields.function_field import FunctionField
from regnf_core.fields.trilinear import corner_offsets, interpolate, interpolate_with_derivative
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
        )

    def value(self, points: Tensor) -> Tensor:
        """Value (N,) at points (N, 3)."""
        return interpolate(*self._corners(points))

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Value (N,) at points (N, 3) and its gradient (N, 3); on a cell's border, that of the cell beyond."""
        value, derivative = interpolate_with_derivative(*self._corners(points))
        return value, derivative.T / self.voxel_size

    def _corners(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The values (2, 2, 2, N) at the corners of the points' cells, and the weights (3, N) of the upper ones."""
        position = (points - self.origin) / self.voxel_size
        cell = position.floor()
        nodes = cell.long() + corner_offsets(self.device)[:, None]  # (8, N, 3)
        return self._node_values(nodes).view(2, 2, 2, -1), (position - cell).T

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
        x, y, z = inside.unbind(-1)
        value = self.values.view(-1)[((row * edge + x) * edge + y) * edge + z].float()
        away: Tensor = (local - inside).to(value.dtype).norm(dim=-1)
        return value + self.outward * self.voxel_size * away


def build_voxel_blocks(
    description: VoxelBlocksDescription, tensors: Mapping[str, Tensor]
) -> FunctionField[VoxelBlocksFunction]:
    """The field of ``description`` with its values in ``tensors``.

    The values keep their device and type; the tensors must have passed :meth:`VoxelBlocksDescription.check_tensors`.
    Raises FieldFormatError (FIELD_INDEX_INVALID).
    """
    values, blocks = tensors["values"].contiguous(), tensors["blocks"].long()
    origin = torch.tensor(description.origin, dtype=torch.float32, device=values.device)
    function = VoxelBlocksFunction(
        values, blocks, CellIndex.of(blocks), origin, description.voxel_size, float(description.sign)
    )
    return FunctionField(function, torch.tensor(description.function_bounds, dtype=torch.float64))
