"""A field known in blocks of voxels where something was seen, interpolated between the voxels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.observation import OnDevice
from regnf_core.fields.user_fields import FunctionField
from regnf_core.native import steps as compiled
from regnf_core.native.steps import NativeModel
from regnf_core.schema.kinds import VoxelBlocksDescription

# Which cells of an endless lattice are occupied, and which occupied cells are nearest to any other.

_FARTHEST = 1 << 20
"""Cells lie less far from cell (0, 0, 0) along each axis, so that a cell of their box has a number below 2^63."""
_TABLE_CELLS = 1 << 18
_NEIGHBORS = 4


@dataclass(frozen=True)
class CellIndex(OnDevice):
    """Finds the rows of occupied cells. Its memory follows the number of cells, not the space between them.

    low, size: (3,) int64, the box around the cells · keys: (N,), the cells' numbers within it, ascending · rows: (N,),
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
            message = "there are no cells, or one is too far from the origin"
            raise FieldFormatError(message, reason="FIELD_INDEX_INVALID")
        low, high = cells.amin(0), cells.amax(0)
        size = high - low + 1
        keys, rows = _cell_number(cells - low, size).sort()
        if bool((keys.diff() == 0).any()):
            raise FieldFormatError("a cell occurs twice", reason="FIELD_INDEX_INVALID")
        step = 1  # the least edge of the table's cells that keeps the table small
        while math.prod(math.ceil(int(extent) / step) for extent in size) > _TABLE_CELLS:
            step += max(1, step // 4)
        return cls(low, size, keys, rows, _nearest_rows(cells, low, size, step).to(cells.device), step)

    def find(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Of cells (..., 3) the row, and whether there is one; the row means nothing where there is none."""
        offset = cells - self.low
        inside = ((offset >= 0) & (offset < self.size)).all(-1)
        number = torch.where(inside, _cell_number(offset, self.size), 0)
        place = torch.searchsorted(self.keys, number).clamp_max(self.keys.shape[0] - 1)
        return self.rows[place], inside & (self.keys[place] == number)

    def nearest(self, cells: Tensor) -> Tensor:
        """The rows (..., K) of K occupied cells near each cell (..., 3): four, or all where there are fewer."""
        offset = torch.minimum((cells - self.low).clamp_min(0), self.size - 1) // self.step
        return self.table[offset[..., 0], offset[..., 1], offset[..., 2]]


def _cell_number(offset: Tensor, size: Tensor) -> Tensor:
    return (offset[..., 0] * size[1] + offset[..., 1]) * size[2] + offset[..., 2]


def _nearest_rows(cells: Tensor, low: Tensor, size: Tensor, step: int) -> Tensor:
    """The table: for the middle of every ``step``^3 cells of the box the rows of the nearest of ``cells`` (N, 3)."""
    axes = [torch.arange(math.ceil(int(extent) / step), dtype=torch.float64) for extent in size]
    middles = low.cpu() + step * torch.cartesian_prod(*axes) + (step - 1) / 2.0
    count = min(_NEIGHBORS, cells.shape[0])
    _, rows = cKDTree(cells.cpu().numpy()).query(middles.numpy(), k=range(1, count + 1))
    return torch.from_numpy(rows).view(*[len(axis) for axis in axes], count)


# Trilinear interpolation from a cell's eight corners, and its derivative.


def interpolate(corners: Tensor, weights: Tensor) -> Tensor:
    """The value (N, ...) within the cell, from the corners' (2, 2, 2, N, ...), x first.

    weights: (3, N, ...), the share of the upper corner along x, y and z; its trailing axes broadcast.
    """
    for weight in weights:
        corners = torch.lerp(corners[0], corners[1], weight)
    return corners


def interpolate_with_derivative(corners: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`interpolate`, and its derivative (3, N, ...) by the weights."""
    derivatives: list[Tensor] = []
    for weight in weights:
        derivatives = [torch.lerp(d[0], d[1], weight) for d in derivatives]
        derivatives.append(corners[1] - corners[0])
        corners = torch.lerp(corners[0], corners[1], weight)
    return corners, torch.stack(derivatives)


def interpolate_colors(corners: Tensor, weights: Tensor) -> Tensor:
    """Color (N, 3) within the cell from the corners' (8, N, 3), as :func:`interpolate`; black where none has one.

    A corner with a negative number has no color, and the others count.
    """
    corners = corners.float()
    known = (corners >= 0.0).all(-1, keepdim=True)
    corners = torch.cat((torch.where(known, corners, 0.0), known), dim=-1)
    mixed = interpolate(corners.view(2, 2, 2, -1, 4), weights[..., None])
    return (mixed[:, :3] / mixed[:, 3:].clamp_min(1e-9)).clamp(0.0, 1.0)


def corner_offsets(device: torch.device) -> Tensor:
    """(8, 3) int64: the corners of a cell, z fastest, in the order that :func:`interpolate` wants them."""
    pair = torch.arange(2, device=device)
    return torch.cartesian_prod(pair, pair, pair)


@dataclass(frozen=True)
class VoxelBlocksFunction(OnDevice):
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
        return self.values.device

    @property
    def has_color(self) -> bool:
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


class VoxelBlocksField(FunctionField[VoxelBlocksFunction]):
    """A :class:`VoxelBlocksFunction` as an SdfField. Where there is compiled code, it has no use for chunks."""

    def native_model(self) -> NativeModel | None:
        """For compiled code, which reads the values where they are."""
        own, steps = self.function, compiled.steps_for()
        if steps is None or not _suits(own):
            return None
        box, lengths = (own.index.low, own.index.size), (own.voxel_size, own.outward)
        table, step = own.index.table, own.index.step
        described = compiled.blocks(box, self._slots, table, step, own.origin, lengths, own.values, own.blocks)
        return NativeModel(steps.blocks, described)

    @cached_property
    def _slots(self) -> Tensor:
        """Made when compiled code first needs them: to open a map takes no longer."""
        steps = compiled.steps_for()
        assert steps is not None
        return compiled.block_slots(steps, self.function.index.keys, self.function.index.rows)

    def signed_distance(self, points: Tensor) -> Tensor:
        model = self.native_model()
        return super().signed_distance(points) if model is None else model.value(_given(points))

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        model = self.native_model()
        if model is None:
            return super().signed_distance_and_gradient(points)
        return model.value_and_gradient(_given(points))


def _given(points: Tensor) -> Tensor:
    return points.detach().to(device="cpu", dtype=torch.float32)


def _suits(function: VoxelBlocksFunction) -> bool:
    """Whether the arrays are as compiled code reads them: it trusts their sizes."""
    values, index, blocks = function.values, function.index, function.blocks
    whole = (blocks, index.keys, index.rows, index.table)
    return (
        all(one.device.type == "cpu" and one.is_contiguous() for one in (values, *whole))
        and all(one.dtype == torch.int64 for one in whole)
        and values.dtype in (torch.float32, torch.float16)
        and values.shape == (len(blocks), *values.shape[-1:] * 3)
        and len(index.rows) == len(blocks)
    )


def build_voxel_blocks(
    description: VoxelBlocksDescription, tensors: Mapping[str, Tensor], colors: Tensor | None = None
) -> VoxelBlocksField:
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
    return VoxelBlocksField(function, torch.tensor(description.function_bounds, dtype=torch.float64))
