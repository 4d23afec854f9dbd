"""Fields of the neus-facto kind: hash encoding, sines and cosines and the point itself into a small network.

The function is that of sdfstudio's and nerfstudio's neus-facto, of NeuS (no grid) and of kin; a description says which.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.contraction import contract_linf, pull_back_linf
from regnf_core.fields.description import SKIP_LAYER, Contraction
from regnf_core.fields.geometry_mlp import GeometryMlp
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.positional_encoding import PositionalEncoding

_CHUNK = 1 << 12
_CHUNK_ACCELERATOR = 1 << 18


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

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3)."""
        z, grid_points = self._coordinates(points)
        parts = [z]
        if self.positional_encoding is not None:
            parts.append(self.positional_encoding.encode(z))
        if self.hash_encoding is not None:
            parts.append(self.hash_encoding.encode(self._to_unit(grid_points)))
        return self.mlp(torch.cat(parts, dim=-1))

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3) with respect to them, in closed form."""
        z, grid_points = self._coordinates(points)
        parts, jacobian = [z], None
        if self.positional_encoding is not None:
            parts.append(self.positional_encoding.encode(z))
        if self.hash_encoding is not None:
            encoded, jacobian = self.hash_encoding.encode_with_derivative(self._to_unit(grid_points))
            parts.append(encoded)
        distance, by_feature = self.mlp.with_gradient(torch.cat(parts, dim=-1))
        by_part = torch.split(by_feature, [part.shape[1] for part in parts], dim=-1)
        gradient = by_part[0]
        if self.positional_encoding is not None:
            gradient = gradient + self.positional_encoding.pull_back(parts[1], by_part[1])
        if jacobian is not None:
            by_grid = (jacobian * by_part[-1]).sum(dim=-1).T / (2.0 * self.grid_radius)  # (N, 3)
            if self.contraction == "linf_grid":
                by_grid = pull_back_linf(points, by_grid)
            gradient = gradient + by_grid
        if self.contraction == "linf":
            gradient = pull_back_linf(points, gradient)
        return distance, gradient

    def _coordinates(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The points as the network sees them, and as the hash grid sees them."""
        if self.contraction == "none":
            return points, points
        contracted = contract_linf(points)
        return (contracted if self.contraction == "linf" else points), contracted

    def _to_unit(self, grid_points: Tensor) -> Tensor:
        return (grid_points + self.grid_radius) / (2.0 * self.grid_radius)


class NeusFactoField:
    """A :class:`NeusFactoFunction` as an SdfField: no autograd graph, in chunks, on the device of its parameters.

    bounds: (2, 3), lowest and highest corner of the region where the field has meaning, own frame.
    chunk: points evaluated at once; None picks what suits the device (CPU: what fits its cache).
    """

    def __init__(self, function: NeusFactoFunction, bounds: Tensor, chunk: int | None = None) -> None:
        self.function = function
        self.chunk = chunk
        self._bounds = torch.as_tensor(bounds, dtype=torch.float64, device="cpu")

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU, own frame."""
        return self._bounds

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        return self.function.mlp.weights[0].device

    def to(self, device: torch.device | str) -> NeusFactoField:
        """The same field with its parameters on another device."""
        old = self.function
        weights, biases = ([t.to(device) for t in tensors] for tensors in (old.mlp.weights, old.mlp.biases))
        mlp = GeometryMlp(weights, biases, old.mlp.skip_at or SKIP_LAYER)
        grid = old.hash_encoding
        if grid is not None:
            grid = HashEncoding(grid.config, grid.table.to(device), grid.active_levels)
        function = NeusFactoFunction(mlp, old.positional_encoding, grid, old.contraction, old.grid_radius)
        return NeusFactoField(function, self._bounds, self.chunk)

    @torch.no_grad()
    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3)."""
        return torch.cat([self.function.value(part) for part in self._chunks(points)])

    @torch.no_grad()
    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) at points (N, 3)."""
        parts = [self.function.value_and_gradient(part) for part in self._chunks(points)]
        return torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts])

    def _chunks(self, points: Tensor) -> tuple[Tensor, ...]:
        size = self.chunk or (_CHUNK if self.device.type == "cpu" else _CHUNK_ACCELERATOR)
        return torch.split(points.to(device=self.device, dtype=torch.float32), size)
