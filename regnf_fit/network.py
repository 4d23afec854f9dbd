"""The trainable network of a field that is fitted: a hash table and a few layers, of the kind ``neus_facto``."""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from regnf_core.fields.color_head import PositionalEncoding
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.neus_facto_function import GeometryMlp, NeusFactoFunction
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
        table = torch.rand(grid.entries, grid.features_per_level, generator=generator)
        self.table = nn.Parameter((2.0 * table - 1.0) * _TABLE_SPREAD)
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
        tensors: dict[str, Tensor] = {"hash_table": table.half() if self.options.half_table else table}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"] = weight.detach(), bias.detach()
        return {name: tensor.cpu().numpy() for name, tensor in tensors.items()}


def random_layers(widths: list[int], generator: torch.Generator) -> tuple[list[Tensor], list[Tensor]]:
    """Random weights (out, in) and zero biases (out,) of layers with so many columns, the last of so many rows."""
    weights = [
        torch.randn(rows, columns, generator=generator) * math.sqrt(2.0 / rows)
        for columns, rows in itertools.pairwise(widths)
    ]
    return weights, [torch.zeros(len(weight)) for weight in weights]


def make_optimizer(
    table: nn.Parameter, networks: list[nn.Parameter], options: NetworkOptions, *more: dict[str, Any]
) -> torch.optim.Adam:
    """Adam with one rate for the hash table and one for the networks. more: further parameter groups."""
    return torch.optim.Adam(
        [
            {"params": [table], "lr": options.table_rate, "eps": 1e-15},
            {"params": networks, "lr": options.network_rate},
            *more,
        ],
        betas=(0.9, 0.99),
        fused=True,
    )
