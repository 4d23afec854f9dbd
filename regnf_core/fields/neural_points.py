"""A field of neural points: features at points of a map, blended and decoded (PIN-SLAM, Pan et al. 2024)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.neus_facto_function import GeometryMlp
from regnf_core.fields.observation import OnDevice
from regnf_core.fields.user_fields import FunctionField
from regnf_core.fields.voxel_blocks import CellIndex
from regnf_core.geometry.exponential_map import matrix_from_quaternion
from regnf_core.schema.kinds import NeuralPointsDescription

_PRIMES = (73856093, 19349669, 83492791)
_EPSILON = 1e-15


@dataclass(frozen=True)
class PointTable(OnDevice):
    """At most one point a cell, found as the trainer finds it: by the cell's number in a buffer that may be too small.

    keys: (M,) int64, the taken numbers, ascending · rows: (M,), the point of each · offsets: (C,) the numbers of the
    cells around a cell, relative to its own.
    """

    keys: Tensor
    rows: Tensor
    offsets: Tensor
    cell_size: float
    buffer_size: int

    @classmethod
    def of(cls, points: Tensor, cell_size: float, buffer_size: int, reach: float) -> PointTable:
        """The table of points (N, 3); of those with one number the last counts. reach: of a search, in cells."""
        number = _number((points / cell_size).floor().long(), buffer_size)
        keys, order = number.sort(stable=True)
        last = torch.ones_like(keys, dtype=torch.bool)
        last[:-1] = keys.diff() > 0
        span = torch.arange(-int(reach), int(reach) + 1, device=points.device)
        around = torch.cartesian_prod(span, span, span)
        around = around[around.square().sum(-1) < reach * reach]
        return cls(keys[last], order[last], _number(around, buffer_size), cell_size, buffer_size)

    def around(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """The points (N, C) in the cells round places (N, 3), and whether there is one in each."""
        own = _number((places / self.cell_size).floor().long(), self.buffer_size)
        number = (own[:, None] + self.offsets).remainder_(self.buffer_size)
        place = torch.searchsorted(self.keys, number).clamp_max_(self.keys.shape[0] - 1)
        return self.rows[place], self.keys[place] == number


@dataclass(frozen=True)
class _Blend:
    """The K nearest points of N places: which (N, K), their shares (N, K), which sum to 1, and where the places are
    relative to them (N, K, 3), zero for points out of reach."""

    points: Tensor
    shares: Tensor
    relative: Tensor


@dataclass(frozen=True)
class NeuralPointsFunction(OnDevice):
    """[feature, relative position] of the nearest points, blended by inverse square distance, into a ReLU network.

    points: (P, 3) · features: (P, F) · rotations: (P, 3, 3), which turn a relative position into a point's own frame,
    or None. Where no point is in reach the value is the distance to a point close by.
    """

    points: Tensor
    features: Tensor
    rotations: Tensor | None
    table: PointTable
    cells: CellIndex
    cell_points: Tensor
    """(M,): for each row of ``cells`` a point in that cell."""
    mlp: GeometryMlp
    neighbors: int
    max_distance: float
    blend_first: bool
    """True: features are blended, then decoded; false: the other way round."""

    @property
    def device(self) -> torch.device:
        return self.points.device

    def value(self, points: Tensor) -> Tensor:
        return self.value_and_gradient(points)[0]

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3), in closed form.

        The field has steps where the nearest points change; the gradient is that between the steps.
        """
        near, in_reach = self._nearest(points)
        known = in_reach.any(-1)
        value, gradient = self._away(points)
        if bool(known.any()):
            blend = self._blend(points[known], near[known], in_reach[known])
            value[known], gradient[known] = self._decode(blend)
        return value, gradient

    def _nearest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The nearest map points (N, K), and which of them are in reach."""
        candidates, there = self.table.around(points)
        squared = (points[:, None] - self.points[candidates]).square().sum(-1)
        there = there & (squared <= self.max_distance**2)
        squared = torch.where(there, squared, torch.inf)
        count = min(self.neighbors, squared.shape[1])
        _, order = squared.topk(count, dim=-1, largest=False)
        return candidates.gather(1, order), there.gather(1, order)

    def _blend(self, points: Tensor, near: Tensor, in_reach: Tensor) -> _Blend:
        relative = points[:, None] - self.points[near]
        inverse = torch.where(in_reach, 1.0 / (relative.square().sum(-1) + _EPSILON), 0.0)
        relative = torch.where(in_reach[..., None], relative, 0.0)
        return _Blend(near, inverse / inverse.sum(-1, keepdim=True), relative)

    def _decode(self, blend: _Blend) -> tuple[Tensor, Tensor]:
        """Value (N,) and gradient (N, 3) of the blended, decoded features.

        The shares s_k = u_k / sum u with u = 1 / |r|^2 have the gradient s_k (g_k - sum s g), g_k = -2 r_k / |r_k|^2.
        """
        r, shares = blend.relative, blend.shares
        turned = r if self.rotations is None else (self.rotations[blend.points] @ r[..., None]).squeeze(-1)
        inputs = torch.cat((self.features[blend.points], turned), dim=-1)  # (N, K, F + 3)
        by_share = -2.0 * r / (r.square().sum(-1, keepdim=True) + _EPSILON)
        by_share = shares[..., None] * (by_share - (shares[..., None] * by_share).sum(1, keepdim=True))  # (N, K, 3)
        if self.blend_first:
            value, by_input = self.mlp.with_gradient((shares[..., None] * inputs).sum(1))
            worth = (inputs * by_input[:, None]).sum(-1)  # (N, K), what a share is worth
            by_relative = by_input[:, None, -3:].expand_as(r)
        else:
            flat, flat_gradient = self.mlp.with_gradient(inputs.flatten(0, 1))
            worth = flat.view(shares.shape)
            value = (shares * worth).sum(-1)
            by_relative = flat_gradient[:, -3:].view(r.shape)
        if self.rotations is not None:
            by_relative = (by_relative[:, :, None] @ self.rotations[blend.points]).squeeze(-2)
        gradient = (by_share * worth[..., None]).sum(1) + (shares[..., None] * by_relative).sum(1)
        return value, gradient

    def _away(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The distance (N,) to the nearest of a few map points close by, and its gradient (N, 3)."""
        close = self.cell_points[self.cells.nearest((points / self.table.cell_size).floor().long())]  # (N, K)
        offset = points[:, None] - self.points[close]
        distance, which = offset.norm(dim=-1).min(dim=-1)
        towards = offset[torch.arange(points.shape[0], device=points.device), which]
        return distance, towards / distance.clamp_min(1e-12)[:, None]


def build_neural_points(
    description: NeuralPointsDescription, tensors: Mapping[str, Tensor]
) -> FunctionField[NeuralPointsFunction]:
    """The field of ``description`` with its parameters in ``tensors``, in float32.

    Tensors keep their device; they must have passed :meth:`NeuralPointsDescription.check_tensors`.
    Raises FieldFormatError (FIELD_INDEX_INVALID).
    """
    points = tensors["points"].float()
    cells, rows = torch.unique((points / description.cell_size).floor().long(), dim=0, return_inverse=True)
    cell_points = torch.empty(cells.shape[0], dtype=torch.int64, device=points.device)
    cell_points[rows] = torch.arange(points.shape[0], device=points.device)
    orientations = tensors.get("orientations")
    function = NeuralPointsFunction(
        points=points,
        features=tensors["features"].float(),
        rotations=None if orientations is None else _to_own_frame(orientations.float()),
        table=PointTable.of(points, description.cell_size, description.buffer_size, description.reach),
        cells=CellIndex.of(cells),
        cell_points=cell_points,
        mlp=GeometryMlp.from_tensors(tensors),
        neighbors=description.neighbors,
        max_distance=description.max_distance,
        blend_first=description.blend_first,
    )
    return FunctionField(function, torch.tensor(description.function_bounds, dtype=torch.float64))


def _number(cell: Tensor, buffer_size: int) -> Tensor:
    return (cell * torch.tensor(_PRIMES, device=cell.device)).sum(-1).remainder(buffer_size)


def _to_own_frame(quaternions: Tensor) -> Tensor:
    """The rotations (P, 3, 3) by the conjugates of unit quaternions (P, 4), real part first."""
    real_last = torch.nn.functional.normalize(quaternions, dim=-1).roll(-1, dims=-1)
    return matrix_from_quaternion(real_last).mT.contiguous()
