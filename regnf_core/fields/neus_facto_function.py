"""The function of fields of the neus-facto kind, in plain tensor algebra: fitting and evaluation share it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.color_head import Appearance, ColorHead, PositionalEncoding
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.mlp import ACTIVATIONS
from regnf_core.fields.observation import OnDevice
from regnf_core.schema.kinds import Contraction
from regnf_core.schema.tensor_check import count_layers

# The contraction that squeezes all of space into the cube [-2, 2]^3, in the infinity norm (Barron et al. 2022).


def contract_linf(points: Tensor) -> Tensor:
    """Points (N, 3) with |x|_inf >= 1 moved to (2 - 1/|x|_inf) x/|x|_inf, the others unchanged."""
    norm = points.abs().amax(dim=-1, keepdim=True).clamp_min(1.0)
    return points * ((2.0 - 1.0 / norm) / norm)


def pull_back_linf(points: Tensor, gradient: Tensor) -> Tensor:
    """Gradient (N, 3) with respect to the points (N, 3), from the one (N, 3) with respect to the contracted points.

    With m = |x|_inf and c(m) = 2/m - 1/m^2 the contraction is c x and its Jacobian c I + c'(m) sign(x_j) x e_j^T,
    where j is the largest axis.
    """
    largest, axis = points.abs().max(dim=-1, keepdim=True)
    m = largest.clamp_min(1.0)
    slope = torch.where(largest >= 1.0, (2.0 / m - 2.0) / (m * m), torch.zeros_like(m))  # c'(m)
    along = slope * (points * gradient).sum(dim=-1, keepdim=True) * points.gather(-1, axis).sign()
    return (gradient * ((2.0 - 1.0 / m) / m)).scatter_add(-1, axis, along)


# The small network that turns a point's features into its signed distance, and its derivative in closed form.


class GeometryMlp:
    """Linear layers with an activation between; where there are more than ``skip_at``, that one sees the input again.

    weights[i]: (out_i, in_i), biases[i]: (out_i,), weight normalization already folded in. Of the last layer only the
    first row is evaluated: the signed distance. The skip connection feeds [h, input] / sqrt 2; skip_at None: there is
    none. activation: "softplus" (of 100 a, over 100), "relu" or "sine".
    """

    def __init__(
        self,
        weights: Sequence[Tensor],
        biases: Sequence[Tensor],
        skip_at: int | None = 4,
        activation: str = "softplus",
    ) -> None:
        self.weights = [*weights[:-1], weights[-1][:1]]
        self.biases = [*biases[:-1], biases[-1][:1]]
        self.skip_at = skip_at if skip_at is not None and len(self.weights) > skip_at else None
        self.activation = activation
        self._function = ACTIVATIONS[activation]

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], skip_at: int | None = None, activation: str = "relu"
    ) -> GeometryMlp:
        """The network in the tensors ``layers.{i}.weight`` and ``layers.{i}.bias`` of a stored field, in float32."""
        layers = range(count_layers(tensors))
        weights, biases = ([tensors[f"layers.{i}.{part}"].float() for i in layers] for part in ("weight", "bias"))
        return cls(weights, biases, skip_at, activation)

    def to(self, device: torch.device | str) -> GeometryMlp:
        weights, biases = ([t.to(device) for t in tensors] for tensors in (self.weights, self.biases))
        return GeometryMlp(weights, biases, self.skip_at, self.activation)

    def __call__(self, features: Tensor) -> Tensor:
        """Signed distance (N,) of features (N, in)."""
        return self._linear(len(self.weights) - 1, self.hidden(features), features).squeeze(-1)

    def hidden(self, features: Tensor) -> Tensor:
        """What the last layer is fed (N, width), of features (N, in)."""
        h = features
        for layer in range(len(self.weights) - 1):
            h = self._function.value(self._linear(layer, h, features))
        return h

    def with_gradient(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) of features (N, in) and its gradient (N, in) by them, by reverse accumulation."""
        h, slopes = self._forward(features)
        distance = self._linear(len(self.weights) - 1, h, features).squeeze(-1)
        return distance, self._gradient(slopes, features)

    def last_inputs_and_gradient(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """What the last layer multiplies (N, its columns), of features (N, in), and the distance's gradient (N, in)."""
        h, slopes = self._forward(features)
        return self._with_skip(len(self.weights) - 1, h, features), self._gradient(slopes, features)

    def _forward(self, features: Tensor) -> tuple[Tensor, list[Tensor]]:
        """What the last layer is fed (N, width), and the slopes of the activations before it."""
        h, slopes = features, []
        for layer in range(len(self.weights) - 1):
            a = self._linear(layer, h, features)
            slopes.append(self._function.slope(a))
            h = self._function.value(a)
        return h, slopes

    def _gradient(self, slopes: list[Tensor], features: Tensor) -> Tensor:
        """Of the distance, by the features (N, in)."""
        gradient = self.weights[-1].expand(features.shape[0], -1)
        skipped = None
        if self.skip_at == len(self.weights) - 1:
            gradient, skipped = self._split_skip(gradient, features)
        for layer in reversed(range(len(self.weights) - 1)):
            gradient = (gradient * slopes[layer]) @ self.weights[layer]
            if layer == self.skip_at:
                gradient, skipped = self._split_skip(gradient, features)
        return gradient if skipped is None else gradient + skipped

    def _linear(self, layer: int, h: Tensor, features: Tensor) -> Tensor:
        return torch.addmm(self.biases[layer], self._with_skip(layer, h, features), self.weights[layer].T)

    def _with_skip(self, layer: int, h: Tensor, features: Tensor) -> Tensor:
        return torch.cat((h, features), dim=-1) / math.sqrt(2.0) if layer == self.skip_at else h

    @staticmethod
    def _split_skip(gradient: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        gradient = gradient / math.sqrt(2.0)
        split = gradient.shape[1] - features.shape[1]
        return gradient[:, :split], gradient[:, split:]


@dataclass(frozen=True)
class NeusFactoFunction(OnDevice):
    """x -> z -> [z, sines and cosines of z, hash features of (z + r) / 2r] -> network -> signed distance.

    Differentiable with respect to the table and the layers (not the points), so that fitting and evaluation share it.
    """

    mlp: GeometryMlp
    positional_encoding: PositionalEncoding | None
    hash_encoding: HashEncoding | None
    contraction: Contraction = "none"
    """``linf``: z is the contracted point; ``linf_grid``: only the hash grid sees the contracted point (nerfstudio)."""
    grid_radius: float = 2.0
    """r: the hash grid covers [-r, r]^3."""
    head: ColorHead | None = None
    """The color, if there is one."""

    @property
    def device(self) -> torch.device:
        return self.mlp.weights[0].device

    @property
    def has_color(self) -> bool:
        return self.head is not None

    def value(self, points: Tensor) -> Tensor:
        return self.mlp(self.encode(points))

    def encode(self, points: Tensor) -> Tensor:
        """What the network is fed (N, in) at points (N, 3)."""
        z, grid_points = self.coordinates(points)
        parts = [z]
        if self.positional_encoding is not None:
            parts.append(self.positional_encoding.encode(z))
        if self.hash_encoding is not None:
            parts.append(self.hash_encoding.encode(self.to_unit(grid_points)))
        return torch.cat(parts, dim=-1)

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        parts, jacobian = self._encode_with_derivative(points)
        distance, by_feature = self.mlp.with_gradient(torch.cat(parts, dim=-1))
        gradient = self._by_position(points, parts, jacobian, by_feature)
        if self.contraction == "linf":
            gradient = pull_back_linf(points, gradient)
        return distance, gradient

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color (N, 3) at points (N, 3) along unit directions (N, 3)."""
        assert self.head is not None
        parts, jacobian = self._encode_with_derivative(points)
        hidden, by_feature = self.mlp.last_inputs_and_gradient(torch.cat(parts, dim=-1))
        gradient = self._by_position(points, parts, jacobian, by_feature)
        return self.head(Appearance(parts[0], gradient, hidden), directions)

    def _encode_with_derivative(self, points: Tensor) -> tuple[list[Tensor], Tensor | None]:
        """The parts of what the network is fed, z first, and the derivative of the grid's."""
        z, grid_points = self.coordinates(points)
        parts, jacobian = [z], None
        if self.positional_encoding is not None:
            parts.append(self.positional_encoding.encode(z))
        if self.hash_encoding is not None:
            encoded, jacobian = self.hash_encoding.encode_with_derivative(self.to_unit(grid_points))
            parts.append(encoded)
        return parts, jacobian

    def _by_position(self, points: Tensor, parts: list[Tensor], jacobian: Tensor | None, by_feature: Tensor) -> Tensor:
        """The gradient (N, 3) by z, from that by what the network is fed."""
        by_part = torch.split(by_feature, [part.shape[1] for part in parts], dim=-1)
        gradient = by_part[0]
        if self.positional_encoding is not None:
            gradient = gradient + self.positional_encoding.pull_back(parts[1], by_part[1])
        if jacobian is not None:
            by_grid = (jacobian * by_part[-1]).sum(dim=-1).T / (2.0 * self.grid_radius)  # (N, 3)
            if self.contraction == "linf_grid":
                by_grid = pull_back_linf(points, by_grid)
            gradient = gradient + by_grid
        return gradient

    def gradient_by_level(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Value (N,) at points (N, 3), its gradient (N, 3) but for the grid's part, and each level's part (A, N, 3)."""
        parts, jacobian = self._encode_with_derivative(points)
        assert self.hash_encoding is not None
        assert jacobian is not None
        distance, by_feature = self.mlp.with_gradient(torch.cat(parts, dim=-1))
        rest = self._by_position(points, parts, None, by_feature)
        by_grid = by_feature[:, -parts[-1].shape[1] :]
        levels = self.hash_encoding.by_level(jacobian * by_grid) / (2.0 * self.grid_radius)
        if self.contraction != "none":
            levels = torch.stack([pull_back_linf(points, level) for level in levels])
        return distance, pull_back_linf(points, rest) if self.contraction == "linf" else rest, levels

    def places(self, points: Tensor) -> Tensor:
        """Where the points (N, 3) lie in the grid's cube, from 0 to 1 (N, 3)."""
        return self.to_unit(self.coordinates(points)[1])

    def coordinates(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The points as the network sees them, and as the hash grid sees them."""
        if self.contraction == "none":
            return points, points
        contracted = contract_linf(points)
        return (contracted if self.contraction == "linf" else points), contracted

    def to_unit(self, grid_points: Tensor) -> Tensor:
        """What the hash grid sees, of any shape, in its cube from 0 to 1."""
        return (grid_points + self.grid_radius) / (2.0 * self.grid_radius)
