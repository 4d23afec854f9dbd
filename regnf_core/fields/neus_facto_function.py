"""The function of fields of the neus-facto kind, in plain tensor algebra: fitting and evaluation share it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.fields.color_head import Appearance, ColorHead
from regnf_core.fields.contraction import contract_linf, pull_back_linf
from regnf_core.fields.geometry_mlp import GeometryMlp
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.positional_encoding import PositionalEncoding
from regnf_core.schema.kinds.neus_facto import Contraction


@dataclass(frozen=True)
class NeusFactoFunction:
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
        """Where the parameters live."""
        return self.mlp.weights[0].device

    def to(self, device: torch.device | str) -> NeusFactoFunction:
        """The same function with its parameters on another device."""
        grid = self.hash_encoding
        if grid is not None:
            grid = HashEncoding(grid.config, grid.table.to(device), grid.active_levels)
        head = None if self.head is None else self.head.to(device)
        return replace(self, mlp=self.mlp.to(device), hash_encoding=grid, head=head)

    @property
    def has_color(self) -> bool:
        """Whether :meth:`color` may be asked."""
        return self.head is not None

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3)."""
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
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3) with respect to them, in closed form."""
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
        if self.hash_encoding is None:
            raise ValueError("a function without a hash grid")
        z, grid_points = self.coordinates(points)
        parts = [z]
        if self.positional_encoding is not None:
            parts.append(self.positional_encoding.encode(z))
        encoded, jacobian = self.hash_encoding.encode_with_derivative(self.to_unit(grid_points))
        distance, by_feature = self.mlp.with_gradient(torch.cat((*parts, encoded), dim=-1))
        by_part = torch.split(by_feature, [*(part.shape[1] for part in parts), encoded.shape[1]], dim=-1)
        rest = by_part[0]
        if self.positional_encoding is not None:
            rest = rest + self.positional_encoding.pull_back(parts[1], by_part[1])
        levels = self.hash_encoding.by_level(jacobian * by_part[-1]) / (2.0 * self.grid_radius)
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
