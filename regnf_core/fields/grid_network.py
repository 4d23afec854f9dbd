"""Position, sines, blobs and a hash grid over a box into one network: MonoSDF's with a grid, and Co-SLAM's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.fields.box_extension import BoxExtension
from regnf_core.fields.function_field import FunctionField
from regnf_core.fields.geometry_mlp import GeometryMlp
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.one_blob import OneBlob
from regnf_core.fields.positional_encoding import PositionalEncoding
from regnf_core.schema.kinds.grid_network import GridNetworkDescription


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
