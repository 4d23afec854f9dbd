"""A field known at the nodes of a regular grid, interpolated between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.fields.box_extension import BoxExtension
from regnf_core.fields.function_field import FunctionField
from regnf_core.fields.trilinear import (
    corner_offsets,
    interpolate,
    interpolate_colors,
    interpolate_with_derivative,
)
from regnf_core.schema.kinds.voxel_grid import VoxelGridDescription


@dataclass(frozen=True)
class VoxelGridFunction:
    """Trilinear interpolation of values (X, Y, Z), float32 or float16; node (i, j, k) is at origin + spacing (i, j, k).

    origin, spacing: (3,) float32. Points are taken to be within the grid.
    """

    values: Tensor
    origin: Tensor
    spacing: Tensor
    colors: Tensor | None = None
    """(X, Y, Z, 3); a node with a negative number has none."""

    @property
    def device(self) -> torch.device:
        """Where the values live."""
        return self.values.device

    def to(self, device: torch.device | str) -> VoxelGridFunction:
        """The same function with its values on another device."""
        return replace(
            self,
            values=self.values.to(device),
            origin=self.origin.to(device),
            spacing=self.spacing.to(device),
            colors=None if self.colors is None else self.colors.to(device),
        )

    @property
    def has_color(self) -> bool:
        """Whether :meth:`color` may be asked."""
        return self.colors is not None

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color (N, 3) at points (N, 3), trilinear between the nodes that have one; black where none has."""
        del directions
        assert self.colors is not None
        index, weights = self._cells(points)
        return interpolate_colors(self.colors.view(-1, 3)[index], weights)

    def value(self, points: Tensor) -> Tensor:
        """Value (N,) at points (N, 3)."""
        return interpolate(*self._corners(points))

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Value (N,) at points (N, 3) and its gradient (N, 3); on a cell's border, that of the cell beyond."""
        value, derivative = interpolate_with_derivative(*self._corners(points))
        return value, derivative.T / self.spacing

    def _corners(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The values (2, 2, 2, N) at the corners of the points' cells, and the weights (3, N) of the upper ones."""
        index, weights = self._cells(points)
        values = self.values.view(-1).index_select(0, index.view(-1)).float()
        return values.view(2, 2, 2, -1), weights

    def _cells(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The corners (8, N) of the points' cells among all nodes, and the weights (3, N) of the upper ones."""
        position = (points - self.origin) / self.spacing
        last = torch.tensor(self.values.shape, device=self.device) - 2
        cell = torch.minimum(position.floor().long().clamp_min(0), last)  # (N, 3)
        _, rows, columns = self.values.shape
        strides = torch.tensor([rows * columns, columns, 1], device=self.device)
        index = (cell * strides).sum(-1) + (corner_offsets(self.device) * strides).sum(-1, keepdim=True)  # (8, N)
        return index, (position - cell).T


def build_voxel_grid(
    description: VoxelGridDescription, tensors: Mapping[str, Tensor], colors: Tensor | None = None
) -> FunctionField[BoxExtension[VoxelGridFunction]]:
    """The field of ``description`` with its values in ``tensors``, extended beyond the grid. colors: of the nodes.

    The tensors keep their device and type; they must have passed :meth:`VoxelGridDescription.check_tensors`.
    """
    values = tensors["values"].contiguous()
    origin = torch.tensor(description.origin, dtype=torch.float64)
    spacing = torch.tensor(description.spacing, dtype=torch.float64)
    high = origin + spacing * (torch.tensor(values.shape) - 1)
    origin, spacing, high = (corner.to(device=values.device, dtype=torch.float32) for corner in (origin, spacing, high))
    colors = None if colors is None else colors.contiguous()
    function = BoxExtension(VoxelGridFunction(values, origin, spacing, colors), origin, high, float(description.sign))
    return FunctionField(function, torch.tensor(description.function_bounds, dtype=torch.float64))
