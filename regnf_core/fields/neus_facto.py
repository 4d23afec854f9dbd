"""Fields of the neus-facto kind: hash encoding, sines and cosines and the point itself into a small network.

The function is that of sdfstudio's and nerfstudio's neus-facto, of NeuS (no grid) and of kin; a description says which.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.fields.contraction import contract_linf, pull_back_linf
from regnf_core.fields.function_field import FunctionField
from regnf_core.fields.geometry_mlp import GeometryMlp
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.positional_encoding import PositionalEncoding
from regnf_core.schema.kinds.neus_facto import SKIP_LAYER, Contraction, NeusFactoDescription


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

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        return self.mlp.weights[0].device

    def to(self, device: torch.device | str) -> NeusFactoFunction:
        """The same function with its parameters on another device."""
        grid = self.hash_encoding
        if grid is not None:
            grid = HashEncoding(grid.config, grid.table.to(device), grid.active_levels)
        return replace(self, mlp=self.mlp.to(device), hash_encoding=grid)

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3)."""
        return self.mlp(self.encode(points))

    def encode(self, points: Tensor) -> Tensor:
        """What the network is fed (N, in) at points (N, 3)."""
        z, grid_points = self._coordinates(points)
        parts = [z]
        if self.positional_encoding is not None:
            parts.append(self.positional_encoding.encode(z))
        if self.hash_encoding is not None:
            parts.append(self.hash_encoding.encode(self._to_unit(grid_points)))
        return torch.cat(parts, dim=-1)

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


class NeusFactoField(FunctionField[NeusFactoFunction]):
    """A :class:`NeusFactoFunction` as an SdfField."""


def build_neus_facto(description: NeusFactoDescription, tensors: Mapping[str, Tensor]) -> NeusFactoField:
    """The field of ``description`` with its parameters in ``tensors`` (names as in the safe format), in float32.

    Tensors keep their device. Columns that only ever saw zeros (an unused encoding, masked levels) are left out.
    The tensors must have passed :meth:`NeusFactoDescription.check_tensors`.
    """
    layers = sum(name.endswith(".weight") for name in tensors)
    weights = [tensors[f"layers.{i}.weight"].float() for i in range(layers)]
    biases = [tensors[f"layers.{i}.bias"].float() for i in range(layers)]
    positional = PositionalEncoding.of(description.positional_encoding)
    grid = None
    if description.hash is not None and description.use_grid:
        grid = HashEncoding(description.hash, tensors["hash_table"].float(), description.level_mask)
    live = torch.tensor(_live_columns(description, positional, grid), device=weights[0].device)
    if len(live) < description.input_width:
        weights[0] = weights[0][:, live]
        if layers > SKIP_LAYER:
            hidden = weights[SKIP_LAYER - 1].shape[0]
            kept = torch.cat((torch.arange(hidden, device=live.device), live + hidden))
            weights[SKIP_LAYER] = weights[SKIP_LAYER][:, kept]
    function = NeusFactoFunction(
        GeometryMlp(weights, biases, SKIP_LAYER), positional, grid, description.contraction, description.grid_radius
    )
    return NeusFactoField(function, torch.tensor(description.function_bounds, dtype=torch.float64))


def _live_columns(
    description: NeusFactoDescription, positional: PositionalEncoding | None, grid: HashEncoding | None
) -> list[int]:
    """The columns of the network's input that are ever fed something other than zero."""
    columns = [0, 1, 2]
    start = 3
    if positional is not None:
        columns += range(start, start + positional.width)
    if description.positional_encoding is not None:
        start += description.positional_encoding.width
    if grid is not None:
        columns += range(start, start + grid.width)
    return columns
