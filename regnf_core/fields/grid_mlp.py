"""A hash grid's features, and nothing else, into a small ReLU network: torch-ngp's and others' fields of meshes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.fields.box_extension import BoxExtension
from regnf_core.fields.function_field import FunctionField
from regnf_core.fields.geometry_mlp import GeometryMlp
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.schema.kinds.grid_mlp import GridMlpDescription


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
