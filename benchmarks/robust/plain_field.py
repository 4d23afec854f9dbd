"""The neus-facto field as one writes it down: a plain torch module straight from the formulas, gradient by autograd.

What the closed form is measured against. It shares no code with the evaluator but the layout of the hash grid.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.safe_format import read_description


class PlainField(nn.Module):
    """The field in a safe file. Neither contraction nor skip connection, as make_fields' fields have none."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        description, tensors = read_description(path), load_file(path)
        self.config = HashGridConfig(**description["hash"])
        self.degree = int(description["positional_encoding"]["degree"])
        self.tables = [part.float() for part in torch.split(tensors["hash_table"], list(self.config.level_entries()))]
        count = sum(name.endswith(".weight") for name in tensors)
        self.layers = nn.ModuleList()
        for i in range(count):
            weight = tensors[f"layers.{i}.weight"].float()
            layer = nn.Linear(weight.shape[1], weight.shape[0])
            layer.weight, layer.bias = (
                nn.Parameter(tensor.float(), requires_grad=False)
                for tensor in (weight, tensors[f"layers.{i}.bias"])
            )  # fmt: skip
            self.layers.append(layer)

    def forward(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3)."""
        angles = (points[..., None] * 2.0 ** torch.arange(self.degree)).flatten(start_dim=1)
        h = torch.cat([points, angles.sin(), angles.cos(), self.hash_features((points + 2.0) / 4.0)], dim=-1)
        for layer in self.layers[:-1]:
            h = functional.softplus(layer(h), beta=100)
        distance: Tensor = self.layers[-1](h)[:, 0]
        return distance

    def shapes(self) -> list[tuple[int, int]]:
        """Inputs and outputs of every layer."""
        return [(layer.in_features, layer.out_features) for layer in self.layers if isinstance(layer, nn.Linear)]

    def hash_features(self, unit: Tensor) -> Tensor:
        """Features (N, levels x features) at points (N, 3) of the unit cube."""
        config, features = self.config, []
        levels = zip(self.tables, config.scales(), config.level_resolutions(), config.level_is_dense(), strict=True)
        for table, scale, resolution, dense in levels:
            position = unit * scale + 0.5
            cell = position.detach().floor()
            w = position - cell
            if config.interpolation == "smoothstep":
                w = w * w * (3.0 - 2.0 * w)
            total = torch.zeros(len(unit), table.shape[1])
            for corner in itertools.product((0, 1), repeat=3):
                node = cell.long() + torch.tensor(corner)
                if dense:
                    index = node[:, 0] + resolution * (node[:, 1] + resolution * node[:, 2])
                else:
                    index = node[:, 0] ^ (node[:, 1] * 2654435761) ^ (node[:, 2] * 805459861)
                share = torch.where(torch.tensor(corner, dtype=torch.bool), w, 1.0 - w).prod(dim=-1)
                total = total + share[:, None] * table[index % len(table)]
            features.append(total)
        return torch.cat(features, dim=-1)

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3), by autograd."""
        points = points.detach().requires_grad_()
        distance = self(points)
        (gradient,) = torch.autograd.grad(distance.sum(), points)
        return distance.detach(), gradient
