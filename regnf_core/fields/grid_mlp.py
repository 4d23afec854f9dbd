"""A hash grid's features, and nothing else, into a small ReLU network: torch-ngp's and others' fields of meshes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Generic, Self, TypeVar

import torch
from torch import Tensor

from regnf_core.fields.color_head import PositionalEncoding
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.neus_facto_function import GeometryMlp
from regnf_core.fields.user_fields import ColoredFunction, FunctionField, SdfFunction
from regnf_core.schema.kinds import GridMlpDescription, GridNetworkDescription

# A function that is defined within a box, extended to all of space.

F = TypeVar("F", bound=SdfFunction)


@dataclass(frozen=True)
class BoxExtension(Generic[F]):
    """g in the box; outside, g at the box's nearest point plus the distance to it. Continuous and finite everywhere.

    What lies outside is taken for free space: the true distance is at most so large, and at least the distance to the
    box where the box holds all of the surface.
    low, high: (3,), the box's corners · outward: -1 where g is negative in free space.
    """

    function: F
    low: Tensor
    high: Tensor
    outward: float = 1.0

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        return self.function.device

    def to(self, device: torch.device | str) -> Self:
        """The same function with its parameters on another device."""
        return replace(self, function=self.function.to(device), low=self.low.to(device), high=self.high.to(device))

    def value(self, points: Tensor) -> Tensor:
        """g (N,) at points (N, 3), extended."""
        inside = self._nearest(points)
        value: Tensor = self.function.value(inside) + self.outward * (points - inside).norm(dim=-1)
        return value

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """g (N,) at points (N, 3), extended, and its gradient (N, 3)."""
        inside = self._nearest(points)
        value, gradient = self.function.value_and_gradient(inside)
        beyond = points - inside
        way = beyond.norm(dim=-1)
        away = beyond / way.clamp_min(torch.finfo(way.dtype).tiny).unsqueeze(-1)
        # Along an axis that leads out, the nearest point of the box stays where it is.
        gradient = torch.where(beyond == 0.0, gradient, 0.0)
        return value + self.outward * way, gradient + self.outward * away

    @property
    def has_color(self) -> bool:
        """Whether :meth:`color` may be asked."""
        return isinstance(self.function, ColoredFunction) and self.function.has_color

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color (N, 3) of g at points (N, 3); outside, that of the box's nearest point."""
        assert isinstance(self.function, ColoredFunction)
        return self.function.color(self._nearest(points), directions)

    def _nearest(self, points: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(points, self.low), self.high)


@dataclass(frozen=True)
class GridMlpFunction:
    """x -> hash features of (x + r) / 2r -> network. Points are taken to be within [-r, r]^3."""

    encoding: HashEncoding
    mlp: GeometryMlp
    radius: float

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        return self.encoding.table.device

    def to(self, device: torch.device | str) -> GridMlpFunction:
        """The same function with its parameters on another device."""
        encoding = HashEncoding(self.encoding.config, self.encoding.table.to(device))
        return replace(self, encoding=encoding, mlp=self.mlp.to(device))

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3)."""
        return self.mlp(self.encoding.encode(self._to_unit(points)))

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3), in closed form."""
        features, jacobian = self.encoding.encode_with_derivative(self._to_unit(points))
        distance, by_feature = self.mlp.with_gradient(features)
        return distance, (jacobian * by_feature).sum(dim=-1).T / (2.0 * self.radius)

    def gradient_by_level(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Value (N,) at points (N, 3), its gradient (N, 3) but for the grid's part (0), and each level's (A, N, 3)."""
        features, jacobian = self.encoding.encode_with_derivative(self._to_unit(points))
        distance, by_feature = self.mlp.with_gradient(features)
        levels = self.encoding.by_level(jacobian * by_feature) / (2.0 * self.radius)
        return distance, torch.zeros_like(points), levels

    def places(self, points: Tensor) -> Tensor:
        """Where the points (N, 3) lie in the grid's cube, from 0 to 1 (N, 3)."""
        return self._to_unit(points)

    def _to_unit(self, points: Tensor) -> Tensor:
        return (points + self.radius) / (2.0 * self.radius)


def build_grid_mlp(
    description: GridMlpDescription, tensors: Mapping[str, Tensor]
) -> FunctionField[BoxExtension[GridMlpFunction]]:
    """The field of ``description`` with its parameters in ``tensors``, in float32, extended beyond the grid's cube.

    Tensors keep their device; they must have passed :meth:`GridMlpDescription.check_tensors`.
    """
    table = tensors["hash_table"].float()
    mlp = GeometryMlp.from_tensors(tensors)
    high = torch.full((3,), description.grid_radius, device=table.device)
    function = GridMlpFunction(HashEncoding(description.hash, table), mlp, description.grid_radius)
    bounds = torch.tensor(description.function_bounds, dtype=torch.float64)
    return FunctionField(BoxExtension(function, -high, high, float(description.sign)), bounds)


# The one-blob encoding (Müller et al. 2019): how much of a bump about a coordinate lies in each bin of [0, 1].


@dataclass(frozen=True)
class OneBlob:
    """``bins`` numbers a coordinate, axis by axis. The bump is a quartic as wide as two bins, and [0, 1] is a ring.

    That is tiny-cuda-nn's: the kernel 15/16 (1 - u^2)^2 with u in bins.
    """

    bins: int

    def encode(self, unit_points: Tensor) -> Tensor:
        """Features (N, 3 bins) at points (N, 3) of the unit cube."""
        below = self._offsets(unit_points).clamp(-1.0, 1.0)
        share = 0.9375 * below * (1.0 - below.square() * (2.0 / 3.0 - 0.2 * below.square()))
        edges = share.sum(dim=-1)
        return (edges[..., 1:] - edges[..., :-1]).flatten(start_dim=1)

    def pull_back(self, unit_points: Tensor, gradient: Tensor) -> Tensor:
        """Gradient (N, 3) with respect to the points, from that by the features (N, 3 bins)."""
        below = self._offsets(unit_points).clamp(-1.0, 1.0)
        slopes = -0.9375 * self.bins * (1.0 - below.square()).square().sum(dim=-1)  # of the edges' shares
        by_bin = slopes[..., 1:] - slopes[..., :-1]
        return (by_bin * gradient.view_as(by_bin)).sum(dim=-1)

    def _offsets(self, unit_points: Tensor) -> Tensor:
        """From the points to the bins' edges, in bins, here and a turn of the ring away: (N, 3, bins + 1, 3)."""
        edges = torch.arange(self.bins + 1, dtype=unit_points.dtype, device=unit_points.device)
        turns = torch.tensor((-self.bins, 0.0, self.bins), dtype=unit_points.dtype, device=unit_points.device)
        return (edges - self.bins * unit_points.unsqueeze(-1)).unsqueeze(-1) + turns


# Position, sines, blobs and a hash grid over a box into one network: MonoSDF's with a grid, and Co-SLAM's.


@dataclass(frozen=True)
class GridNetworkFunction:
    """x -> [x, sines and cosines of x, blobs of u, hash features of u] -> network, with u the place in the box.

    Points are taken to be within the box. low, size: (3,), its lowest corner and its edges.
    """

    mlp: GeometryMlp
    grid: HashEncoding
    low: Tensor
    size: Tensor
    positional_encoding: PositionalEncoding | None = None
    one_blob: OneBlob | None = None

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        return self.grid.table.device

    def to(self, device: torch.device | str) -> GridNetworkFunction:
        """The same function with its parameters on another device."""
        grid = HashEncoding(self.grid.config, self.grid.table.to(device))
        low, size = self.low.to(device), self.size.to(device)
        return replace(self, mlp=self.mlp.to(device), grid=grid, low=low, size=size)

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3)."""
        unit = (points - self.low) / self.size
        return self.mlp(torch.cat((*self._simple_parts(points, unit), self.grid.encode(unit)), dim=-1))

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3), in closed form."""
        unit = (points - self.low) / self.size
        features, jacobian = self.grid.encode_with_derivative(unit)
        parts = [*self._simple_parts(points, unit), features]
        distance, by_feature = self.mlp.with_gradient(torch.cat(parts, dim=-1))
        gradient, *others = torch.split(by_feature, [part.shape[1] for part in parts], dim=-1)
        by_unit = (jacobian * others.pop()).sum(dim=-1).T
        if self.one_blob is not None:
            by_unit = by_unit + self.one_blob.pull_back(unit, others.pop())
        if self.positional_encoding is not None:
            gradient = gradient + self.positional_encoding.pull_back(parts[1], others.pop())
        return distance, gradient + by_unit / self.size

    def _simple_parts(self, points: Tensor, unit: Tensor) -> list[Tensor]:
        """What the network is fed before the grid's features."""
        parts = [points]
        if self.positional_encoding is not None:
            parts.append(self.positional_encoding.encode(points))
        if self.one_blob is not None:
            parts.append(self.one_blob.encode(unit))
        return parts


def build_grid_network(
    description: GridNetworkDescription, tensors: Mapping[str, Tensor]
) -> FunctionField[BoxExtension[GridNetworkFunction]]:
    """The field of ``description`` with its parameters in ``tensors``, in float32, extended beyond the grid's box.

    Tensors keep their device; they must have passed :meth:`GridNetworkDescription.check_tensors`.
    """
    table = tensors["hash_table"].float()
    low, high = torch.tensor(description.grid_box, dtype=torch.float32, device=table.device)
    function = GridNetworkFunction(
        GeometryMlp.from_tensors(tensors, description.skip_layer, description.activation),
        HashEncoding(description.hash, table),
        low,
        high - low,
        PositionalEncoding.of(description.positional_encoding),
        OneBlob(description.one_blob_bins) if description.one_blob_bins else None,
    )
    bounds = torch.tensor(description.function_bounds, dtype=torch.float64)
    return FunctionField(BoxExtension(function, low, high, float(description.sign)), bounds)
