"""Evaluation of a neus-facto function at many points on the CPU: hash grid, encoding and network in planes, no graph.

The class NeusFactoFunction has the same function in plain tensor algebra; tests compare the two, and points beyond the
grid's cube are left to it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.fields.contraction import pull_back_linf
from regnf_core.fields.hash_planes import HashPlanes, planes_of
from regnf_core.fields.neus_facto_function import NeusFactoFunction
from regnf_core.fields.plane_network import PlaneNetwork


class NeusFactoPlanes:
    """A snapshot of the function's parameters, laid out for evaluation: fitting changes them, so it is made anew."""

    def __init__(self, plain: NeusFactoFunction, grid: HashPlanes | None) -> None:
        """grid: of the function's encoding, if it has one."""
        self._plain, self._grid = plain, grid
        weights = [weight.detach() for weight in plain.mlp.weights]
        if plain.hash_encoding is not None:
            self._shape = (plain.hash_encoding.config.features_per_level, plain.hash_encoding.active_levels)
            weights[0] = _feature_first(weights[0], *self._shape)
        self._network = PlaneNetwork(weights, plain.mlp.biases)

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3)."""
        z, unit, within = self._places(points)
        if within is not None:
            distance = self._plain.value(points)
            distance[within] = self.value(points[within])
            return distance
        parts = self._smooth_parts(z)
        if self._grid is not None:
            parts.append(self._grid.features(unit).flatten(0, 1))
        return self._network.value(_with_ones(parts))

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3) with respect to them, in closed form."""
        z, unit, within = self._places(points)
        if within is not None:
            distance, gradient = self._plain.value_and_gradient(points)
            distance[within], gradient[within] = self.value_and_gradient(points[within])
            return distance, gradient
        parts = self._smooth_parts(z)
        encoded = None if self._grid is None else self._grid.with_derivatives(unit)
        if encoded is not None:
            parts.append(encoded.features.flatten(0, 1))
        distance, by_input = self._network.with_gradient(_with_ones(parts))
        gradient = by_input[:3]
        if self._plain.positional_encoding is not None:
            by_sines = by_input[3 : 3 + len(parts[1])]
            gradient = gradient + self._plain.positional_encoding.pull_back_planes(parts[1], by_sines)
        if self._plain.contraction == "linf":
            gradient = self._pulled_back(points, gradient)
        if encoded is not None:
            by_grid = encoded.pull_back(by_input[-len(parts[-1]) :].reshape(*self._shape, len(points)))
            by_grid /= 2.0 * self._plain.grid_radius
            gradient = gradient + (by_grid if self._plain.contraction == "none" else self._pulled_back(points, by_grid))
        return distance, gradient.T

    @staticmethod
    def _pulled_back(points: Tensor, gradient: Tensor) -> Tensor:
        """Gradient (3, N) by the points (N, 3), from that by the contracted points."""
        return pull_back_linf(points, gradient.T).T

    def _places(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """The points as the network sees them and in the grid's unit cube, (3, N) each; and the numbers of those within
        the cube, None where all are."""
        z, grid_points = self._plain.coordinates(points)
        z, unit = z.T.contiguous(), self._plain.to_unit(grid_points.T.contiguous())
        if self._grid is None or not unit.numel():
            return z, unit, None
        low, high = unit.aminmax()
        if low >= 0.0 and high <= 1.0:
            return z, unit, None
        return z, unit, ((unit >= 0.0) & (unit <= 1.0)).all(0).nonzero().squeeze(-1)

    def _smooth_parts(self, z: Tensor) -> list[Tensor]:
        encoding = self._plain.positional_encoding
        return [z] if encoding is None else [z, encoding.encode_planes(z)]


def prepared(function: NeusFactoFunction) -> NeusFactoFunction | NeusFactoPlanes:
    """What evaluates the function's present parameters fastest, without a graph: made anew for each call, because
    fitting changes them."""
    mlp, encoding = function.mlp, function.hash_encoding
    simple = mlp.activation == "softplus" and mlp.skip_at is None and len(mlp.weights) > 1
    if not simple or function.device.type != "cpu":
        return function
    grid = None if encoding is None else planes_of(encoding)
    return function if encoding is not None and grid is None else NeusFactoPlanes(function, grid)


def _with_ones(parts: list[Tensor]) -> Tensor:
    return torch.cat((*parts, torch.ones(1, parts[0].shape[1])))


def _feature_first(weight: Tensor, features: int, levels: int) -> Tensor:
    """The columns of the grid's features, which come level by level, in the order of :class:`HashPlanes`."""
    grid = features * levels
    turned = weight[:, -grid:].reshape(-1, levels, features).transpose(1, 2).flatten(1)
    return torch.cat((weight[:, :-grid], turned), dim=1)
