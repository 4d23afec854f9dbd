"""The multi-resolution hash encoding (Müller et al. 2022), laid out as tiny-cuda-nn does, forward and derivative.

Everything is plain tensor algebra, batched over levels and corners, and differentiable with respect to the table:
evaluation and fitting use the same code. Arrays are laid out corner- and level-first, so that every operation runs over
long rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.schema.hash_grid_config import HashGridConfig

_PRIMES = (1, 2654435761, 805459861)
_UINT32 = 0xFFFFFFFF
_WIDE_TYPES = {1: torch.float32, 2: torch.complex64, 4: torch.complex128}
"""A row of 1, 2 or 4 floats is moved as one element of this type: that is several times faster than moving rows."""


class _GatherRows(torch.autograd.Function):
    """table (E, F), index (M,) -> rows (M, F); the backward pass adds the rows' gradients into the table."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, table: Tensor, index: Tensor) -> Tensor:
        ctx.save_for_backward(index)
        ctx.entries = table.shape[0]  # type: ignore[attr-defined]
        wide = _WIDE_TYPES.get(table.shape[1])
        if wide is None:
            return table.index_select(0, index)
        return table.view(wide).view(-1).index_select(0, index).view(torch.float32).view(-1, table.shape[1])

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (index,) = ctx.saved_tensors  # type: ignore[attr-defined]
        rows = grad_outputs[0].contiguous()
        total = rows.new_zeros(ctx.entries, rows.shape[1])  # type: ignore[attr-defined]
        if rows.shape[1] == 2:
            torch.view_as_complex(total).index_add_(0, index, torch.view_as_complex(rows))
        else:
            total.index_add_(0, index, rows)
        return total, None


@dataclass(frozen=True)
class _Cells:
    """Where N points lie in the A active levels: the eight corners' table rows and the position within the cell."""

    corners: Tensor  # (8 A N,) int64, corner-major (x slowest), then level, then point
    weights: Tensor  # (3, A, N) interpolation weight towards the upper corner along x, y, z
    slopes: Tensor  # (3, A, N) derivative of the weights with respect to the point


@dataclass(frozen=True, eq=False)
class GridLayout:
    """Where levels lie in the table, for compiled code. scales: (A,) float32 · strides: (3, A), entries, offsets: (A,),
    all the lower 32 bits · rows: that the table must have."""

    scales: Tensor
    strides: Tensor
    entries: Tensor
    offsets: Tensor
    rows: int


class HashEncoding:
    """Features of points in the unit cube, interpolated in a table of trained entries.

    table: (entries, features_per_level) float32, level-major as ``config`` lays it out · strides: (3, A, 1), what a
    step along an axis adds to a corner's row, or the hash's factor · entries, offsets: (A, 1) of each level's part of
    the table · dense_levels: the first ones, which are not hashed. With ``active_levels`` only the coarsest levels are
    evaluated (a level mask); the output has their features alone.
    Raises FieldFormatError (FIELD_SHAPES_MISMATCH) when the table does not fit the config.
    """

    def __init__(self, config: HashGridConfig, table: Tensor, active_levels: int | None = None) -> None:
        expected = (config.entries, config.features_per_level)
        if tuple(table.shape) != expected:
            raise FieldFormatError(
                f"hash table has shape {tuple(table.shape)}, expected {expected}", reason="FIELD_SHAPES_MISMATCH"
            )
        self.config = config
        self.table = table
        self.active_levels = config.levels if active_levels is None else min(active_levels, config.levels)
        entries, strides = config.level_entries(), config.level_strides()
        active = slice(0, self.active_levels)
        # Resolutions never fall from level to level, so the dense levels come first.
        self.dense_levels = sum(config.level_is_dense()[active])
        offsets = [sum(entries[:level]) for level in range(config.levels)]
        rows = [(1, nodes, nodes * nodes) for nodes in strides[: self.dense_levels]]
        rows += [_PRIMES] * (self.active_levels - self.dense_levels)
        self.strides = torch.tensor(rows, dtype=torch.int64, device=table.device).T.unsqueeze(-1)  # (3, A, 1)
        self._scales = self._column(torch.tensor(config.scales()[active], dtype=torch.float32))
        self.entries = self._column(torch.tensor(entries[active]))
        self.offsets = self._column(torch.tensor(offsets[active]))

    def to(self, device: torch.device | str) -> HashEncoding:
        """The same with its table on another device."""
        return HashEncoding(self.config, self.table.to(device), self.active_levels)

    @property
    def width(self) -> int:
        """Number of features of an encoded point."""
        return self.active_levels * self.config.features_per_level

    def encode(self, unit_points: Tensor) -> Tensor:
        """Features (N, width) at ``unit_points`` (N, 3). Outside the unit cube the lattice wraps."""
        cells = self._locate(unit_points)
        values = self._gather(cells)  # (2, 2, 2, A, N, F)
        for axis in range(3):
            values = torch.lerp(values[0], values[1], self._per_feature(cells.weights[axis]))
        return self._by_point(values)

    def encode_with_derivative(self, unit_points: Tensor) -> tuple[Tensor, Tensor]:
        """Features (N, width) at ``unit_points`` (N, 3), and their derivatives (3, N, width) along x, y and z."""
        cells = self._locate(unit_points)
        values = self._gather(cells)  # (2, 2, 2, A, N, F)
        derivatives: list[Tensor] = []
        for axis in range(3):
            weight = self._per_feature(cells.weights[axis])
            derivatives = [torch.lerp(d[0], d[1], weight) for d in derivatives]
            derivatives.append((values[1] - values[0]) * self._per_feature(cells.slopes[axis]))
            values = torch.lerp(values[0], values[1], weight)
        return self._by_point(values), torch.stack([self._by_point(d) for d in derivatives])

    @property
    def scales(self) -> Tensor:
        """Cells along an edge of the cube, of each active level (A,)."""
        return self._scales.flatten()

    @cached_property
    def layout(self) -> GridLayout:
        """What the class says of its levels, on the CPU."""
        strides, entries, offsets = (
            lower_32_bits(t.cpu().squeeze(-1)) for t in (self.strides, self.entries, self.offsets)
        )
        rows = int(self.offsets[-1] + self.entries[-1])
        return GridLayout(self.scales.cpu().contiguous(), strides, entries, offsets, rows)

    def by_level(self, values: Tensor) -> Tensor:
        """Sums (A, N, 3) over the features of each level, of values (3, N, width)."""
        levels = values.view(3, values.shape[1], self.active_levels, self.config.features_per_level)
        return levels.sum(dim=-1).permute(2, 1, 0)

    def cells(self, unit_points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The lower corners (3, A, N) of the cells of points (3, N), float32; the weights towards the upper corners
        (3, A, N), and their derivative by the point, (3, A, N)."""
        position = torch.addcmul(unit_points.new_tensor(0.5), unit_points.unsqueeze(1), self._scales)
        cell = position.floor()
        w = position.sub_(cell)
        scales = self._scales.expand_as(w)
        if self.config.interpolation == "smoothstep":
            return cell, w * w * (3.0 - 2.0 * w), 6.0 * w * (1.0 - w) * scales
        return cell, w, scales

    def _locate(self, unit_points: Tensor) -> _Cells:
        cell, weights, slopes = self.cells(unit_points.T)
        return _Cells(self._corner_rows(cell.long()), weights, slopes)

    def _corner_rows(self, cell: Tensor) -> Tensor:
        """Table rows (8 A N,) of the corners of cells (3, A, N) int64.

        The original computes in uint32. Its wrap-around is kept: a hashed level has 2^T entries, so only the low T bits
        count, and those are the same in int64; a dense level's sum is cut to 32 bits before the modulo.
        """
        lower = cell * self.strides
        both = torch.stack((lower, lower + self.strides), dim=1)  # (3, 2, A, N)
        x, y, z = both[0][:, None, None], both[1][None, :, None], both[2][None, None, :]
        d = self.dense_levels
        rows = cell.new_empty(2, 2, 2, *cell.shape[1:])
        dense, hashed = rows[..., :d, :], rows[..., d:, :]
        torch.add(x[..., :d, :], y[..., :d, :] + z[..., :d, :], out=dense)
        dense.bitwise_and_(_UINT32).remainder_(self.entries[:d])
        torch.bitwise_xor(x[..., d:, :], y[..., d:, :] ^ z[..., d:, :], out=hashed)
        hashed.bitwise_and_(self.entries[d:] - 1)
        return rows.add_(self.offsets).view(-1)

    def _gather(self, cells: _Cells) -> Tensor:
        rows: Tensor = _GatherRows.apply(self.table, cells.corners)  # type: ignore[no-untyped-call]
        return rows.view(2, 2, 2, *cells.weights.shape[1:], self.config.features_per_level)

    def _per_feature(self, weights: Tensor) -> Tensor:
        """(A, N) -> (A, N, F), copied: a broadcast along so short a last axis would be slow."""
        return weights.repeat_interleave(self.config.features_per_level, dim=-1).view(
            *weights.shape, self.config.features_per_level
        )

    def _by_point(self, values: Tensor) -> Tensor:
        """(A, N, F) -> (N, A F)."""
        return values.transpose(0, 1).reshape(values.shape[1], self.width)

    def _column(self, values: Tensor) -> Tensor:
        return values.to(self.table.device).unsqueeze(-1)


def lower_32_bits(numbers: Tensor) -> Tensor:
    """int64 as int32 with the same lower 32 bits."""
    lower = numbers & _UINT32
    return torch.where(lower > _UINT32 >> 1, lower - (1 << 32), lower).int().contiguous()
