"""The distance models of several pairs as one: each pose is looked up in the grid, or evaluated in the field, of its
pair."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Protocol

import torch
from torch import Tensor

from regnf_core.fields.observation import CountingField, SdfField
from regnf_core.robust.fused.parts import Part
from regnf_core.robust.residuals import DistanceModel
from regnf_core.robust.search.distance_grid import DistanceGrid, GridCells
from regnf_core.robust.working_frame import WorkingField

_BLOCKS = 8
"""A field is evaluated at so many equal parts of a part's points: the last one is filled up."""


class Stack(Protocol):
    """The distance models of several pairs."""

    def model_of(self, part: Part) -> PartModel:
        """For the poses of a part."""
        ...


class PartModel(Protocol):
    """A distance model for points (H N, 3): N of each pose of a part, in its pair's frame."""

    faulty: Tensor | None
    """(H,) bool: poses that met a value that is not finite; None: there is no such thing."""

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]: ...


def stack_of(models: Sequence[DistanceModel], device: torch.device) -> Stack:
    """The models as one, for points on the device: all are grids, or all are fields in working frames."""
    grids = [one for one in models if isinstance(one, DistanceGrid)]
    if len(grids) == len(models):
        return StackedGrids(grids)
    fields = [one for one in models if isinstance(one, WorkingField)]
    assert len(fields) == len(models), "distance models of two kinds in one batch"
    return StackedFields(fields, device)


class StackedGrids:
    """Grids one after the other; the same grid is held once."""

    def __init__(self, grids: Sequence[DistanceGrid]) -> None:
        places = {id(grid): grid for grid in grids}
        numbers = {key: number for number, key in enumerate(places)}
        cells = [grid.cells for grid in places.values()]
        device = cells[0].planes.device
        self._cells_each = cells[0].planes.numel() // 4
        self._planes = torch.cat([one.planes for one in cells])
        self._corners = [torch.cat([getattr(one, name) for one in cells], 1) for name in ("low", "high", "edge")]
        self._numbers = torch.tensor([numbers[id(grid)] for grid in grids], device=device)

    def model_of(self, part: Part) -> PartModel:
        """For the poses of a part."""
        numbers = self._numbers[part.pairs]
        first = (numbers * self._cells_each).int()
        return _GridsOfPoses(self._planes, [corner[:, numbers] for corner in self._corners], first)


class _GridsOfPoses:
    faulty: Tensor | None = None

    def __init__(self, planes: Tensor, corners: Sequence[Tensor], first: Tensor) -> None:
        self._planes, self._corners, self._first = planes, corners, first

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        poses = len(self._first)
        low, high, edge = (_repeated(corner, len(points) // poses) for corner in self._corners)
        cells = GridCells(self._planes, low, high, edge, _repeated(self._first, len(points) // poses))
        value, gradient = cells.look_up(points.T.contiguous())
        return value, gradient.T


def _repeated(values: Tensor, count: int) -> Tensor:
    """Each of the values (..., H) ``count`` times, (..., H count)."""
    return values[..., None].expand(*values.shape, count).reshape(*values.shape[:-1], -1)


class StackedFields:
    """Fields in working frames. Poses of one field are evaluated together."""

    def __init__(self, fields: Sequence[WorkingField], device: torch.device) -> None:
        self._fields = [_uncounted(one.field) for one in fields]
        self._lengths = torch.tensor([one.frame.length for one in fields], dtype=torch.float64, device=device)
        self._centers = torch.stack([one.frame.center for one in fields]).to(device)

    def model_of(self, part: Part) -> PartModel:
        """For the poses of a part."""
        runs = [(self._fields[pair], count) for pair, count in part.runs]
        joined = [(group[0][0], sum(count for _, count in group)) for group in _alike(runs)]
        return _FieldsOfPoses(joined, self._centers[part.pairs], self._lengths[part.pairs])


def _alike(runs: list[tuple[SdfField, int]]) -> list[list[tuple[SdfField, int]]]:
    """Neighbors in the same field."""
    return [list(group) for _, group in groupby(runs, key=lambda run: id(run[0]))]


def _uncounted(field: SdfField) -> SdfField:
    return field.field if isinstance(field, CountingField) else field


class _FieldsOfPoses:
    def __init__(self, runs: Sequence[tuple[SdfField, int]], centers: Tensor, lengths: Tensor) -> None:
        self._runs, self._centers, self._lengths = runs, centers[:, None], lengths[:, None, None]
        self.faulty: Tensor | None = torch.zeros(len(lengths), dtype=torch.bool, device=lengths.device)

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        poses = len(self._lengths)
        places = points.reshape(poses, -1, 3).double() * self._lengths + self._centers
        own = torch.split(places, [count for _, count in self._runs])
        block = -(-len(points) // _BLOCKS)
        found = [in_blocks(field, some.reshape(-1, 3), block) for (field, _), some in zip(self._runs, own, strict=True)]
        value = torch.cat([one for one, _ in found]).reshape(poses, -1)
        gradient = torch.cat([one for _, one in found]).reshape(poses, -1, 3)
        value = value / self._lengths[:, 0].to(value)
        finite = torch.isfinite(value).all(1) & torch.isfinite(gradient).flatten(1).all(1)
        assert self.faulty is not None
        self.faulty = self.faulty | ~finite
        return value.reshape(-1), gradient.reshape(-1, 3)


def in_blocks(field: SdfField, points: Tensor, block: int) -> tuple[Tensor, Tensor]:
    """Value (M,) and gradient (M, 3) at points (M, 3), always ``block`` points at a time: the last are repeated."""
    count = len(points)
    filled = torch.cat([points, points[-1:].expand(-count % block, 3)])
    found = [field.signed_distance_and_gradient(part) for part in torch.split(filled, block)]
    value, gradient = (torch.cat(parts)[:count].to(points.device, torch.float32) for parts in zip(*found, strict=True))
    return value, gradient
