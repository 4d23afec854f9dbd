"""The trainable network of a field that is fitted: a hash table and a few layers, of the kind ``neus_facto``."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from regnf_core.fields.color_head import PositionalEncoding
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.neus_facto_function import GeometryMlp, NeusFactoFunction
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_fit.options import NetworkOptions

GRID_RADIUS = 2.0
"""The hash grid covers [-2, 2]^3, in the units of the field."""
POSITION_DEGREE = 6
"""Frequencies of the sines and cosines of the position."""
_TABLE_SPREAD = 1e-4


@dataclass(frozen=True)
class StartShape:
    """The sphere that a field starts as: matter within, or (``hollow``) around it. Field units."""

    center: Tensor
    """(3,)"""
    radius: float
    hollow: bool = False


class TrainableField(nn.Module):
    """A neus_facto field with a trainable table and layers, which starts as roughly a sphere.

    The start is the geometric initialization of Atzmon and Lipman (2020, "SAL"): it gives a signed distance from the
    first iteration on. generator: the source of the random start.
    """

    def __init__(self, options: NetworkOptions, start: StartShape, generator: torch.Generator) -> None:
        super().__init__()
        self.options = options
        grid = options.grid
        self.table = random_table(grid, generator)
        self._encoding = PositionalEncoding(POSITION_DEGREE)
        widths = [3 + self._encoding.width + grid.width] + [options.hidden_width] * options.hidden_layers
        weights, biases = random_layers(widths, generator)
        weights[0][:, 3 : 3 + self._encoding.width] = 0.0
        biases[0] -= weights[0][:, :3] @ start.center
        sign = -1.0 if start.hollow else 1.0
        weights.append(torch.full((1, widths[-1]), sign * math.sqrt(math.pi / widths[-1])))
        biases.append(torch.full((1,), -sign * start.radius))
        self.weights, self.biases = nn.ParameterList(weights), nn.ParameterList(biases)

    def function(self) -> NeusFactoFunction:
        """The function of the present parameters, differentiable with respect to them."""
        mlp = GeometryMlp(list(self.weights), list(self.biases))
        return NeusFactoFunction(mlp, self._encoding, HashEncoding(self.options.grid, self.table))

    def description(self, bounds: Tensor, label: str | None, source: dict[str, Any]) -> dict[str, Any]:
        """The description of the stored field. bounds: (2, 3), own frame."""
        return {
            "kind": "neus_facto",
            "hash": asdict(self.options.grid),
            "positional_encoding": {"degree": POSITION_DEGREE, "two_pi": False},
            "use_grid": True,
            "contraction": "none",
            "level_mask": None,
            "bounds": bounds.tolist(),
            "label": label,
            "source": source,
        }

    def tensors(self) -> dict[str, NDArray[Any]]:
        """The parameters of the distance, by the names of the safe format."""
        table = self.table.detach()
        tensors = {"hash_table": table.half() if self.options.half_table else table}
        return arrays_of(tensors | layer_tensors(self.weights, self.biases))


def random_table(grid: HashGridConfig, generator: torch.Generator) -> nn.Parameter:
    """A hash table's start: next to zero."""
    table = torch.rand(grid.entries, grid.features_per_level, generator=generator)
    return nn.Parameter((2.0 * table - 1.0) * _TABLE_SPREAD)


def layer_tensors(weights: Iterable[Tensor], biases: Iterable[Tensor]) -> dict[str, Tensor]:
    """Layers by their names in the safe format."""
    named: dict[str, Tensor] = {}
    for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        named |= {f"layers.{i}.weight": weight, f"layers.{i}.bias": bias}
    return named


def arrays_of(tensors: dict[str, Tensor]) -> dict[str, NDArray[Any]]:
    """The same on the CPU."""
    return {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}


def random_layers(widths: list[int], generator: torch.Generator) -> tuple[list[Tensor], list[Tensor]]:
    """Random weights (out, in) and zero biases (out,) of layers with so many columns, the last of so many rows."""
    weights = [
        torch.randn(rows, columns, generator=generator) * math.sqrt(2.0 / rows)
        for columns, rows in itertools.pairwise(widths)
    ]
    return weights, [torch.zeros(len(weight)) for weight in weights]


def make_optimizer(
    table: nn.Parameter, networks: list[nn.Parameter], table_rate: float, network_rate: float, *more: dict[str, Any]
) -> torch.optim.Adam:
    """Adam with one rate for the hash table and one for the networks. more: further parameter groups."""
    groups = [{"params": [table], "lr": table_rate, "eps": 1e-15}, {"params": networks, "lr": network_rate}, *more]
    return torch.optim.Adam(groups, betas=(0.9, 0.99), fused=True)
