"""The parameters of a field that is being fitted to images: geometry, color and the opacity's sharpness."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from regnf_core.fields.geometry_mlp import GeometryMlp
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.neus_facto import NeusFactoFunction
from regnf_core.fields.positional_encoding import PositionalEncoding
from regnf_fit.images.options import ReconstructionOptions

DEGREE = 6
DIRECTION_DEGREE = 4
COLOR_INPUTS = 3 + (3 + 6 * DIRECTION_DEGREE) + 3
"""Point, direction with its sines and cosines, normal; the geometry's feature follows."""
_TABLE_SPREAD = 1e-4
_COLOR_LAYERS = 2


@dataclass(frozen=True)
class StartShape:
    """The sphere that a field starts as: matter within, or (``hollow``) around. Field units."""

    center: Tensor  # (3,)
    radius: float
    hollow: bool


class RadianceField(nn.Module):
    """A neus-facto field with colors, starting as roughly a sphere.

    The start is the geometric initialization of Atzmon and Lipman (2020, "SAL"): it gives a signed distance from the
    first iteration on. The color's network sees what neus-facto's does, in its order: point, direction, normal,
    feature.
    """

    def __init__(self, options: ReconstructionOptions, start: StartShape, generator: torch.Generator) -> None:
        super().__init__()
        self.options = options
        grid = options.grid
        table = torch.rand(grid.entries, grid.features_per_level, generator=generator)
        self.table = nn.Parameter((2.0 * table - 1.0) * _TABLE_SPREAD)
        self._encoding = PositionalEncoding(DEGREE)
        self._direction_encoding = PositionalEncoding(DIRECTION_DEGREE)
        widths = [3 + self._encoding.width + grid.width] + [options.hidden_width] * options.hidden_layers
        weights, biases = _random_layers(widths, generator)
        weights[0][:, 3 : 3 + self._encoding.width] = 0.0
        biases[0] -= weights[0][:, :3] @ start.center
        sign = -1.0 if start.hollow else 1.0
        weights.append(torch.full((1, widths[-1]), sign * math.sqrt(math.pi / widths[-1])))
        biases.append(torch.full((1,), -sign * start.radius))
        feature = torch.randn(options.feature_width, widths[-1], generator=generator) * math.sqrt(1.0 / widths[-1])
        self.weights, self.biases = nn.ParameterList(weights), nn.ParameterList(biases)
        self.feature_weight = nn.Parameter(feature)
        self.feature_bias = nn.Parameter(torch.zeros(options.feature_width))
        widths = [COLOR_INPUTS + options.feature_width] + [options.hidden_width] * _COLOR_LAYERS + [3]
        weights, biases = _random_layers(widths, generator)
        self.color_weights, self.color_biases = nn.ParameterList(weights), nn.ParameterList(biases)
        self.background = nn.Parameter(torch.zeros(3))
        """Logit of the color behind everything."""
        self.log_sharpness = nn.Parameter(torch.zeros(()))
        """Logarithm of the sharpness over the least one that the schedule allows."""

    def function(self) -> NeusFactoFunction:
        """The field's function of the present parameters, differentiable with respect to them."""
        mlp = GeometryMlp(list(self.weights), list(self.biases))
        return NeusFactoFunction(mlp, self._encoding, HashEncoding(self.options.grid, self.table))

    def distance_and_feature(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3), and the feature (N, F) that the color depends on."""
        function = self.function()
        h = function.mlp.hidden(function.encode(points))
        distance = torch.addmm(self.biases[-1], h, self.weights[-1].T).squeeze(-1)
        return distance, torch.addmm(self.feature_bias, h, self.feature_weight.T)

    def color(self, points: Tensor, directions: Tensor, normals: Tensor, features: Tensor) -> Tensor:
        """Color (N, 3) in [0, 1] of points seen along unit ``directions`` (N, 3)."""
        encoded = self._direction_encoding.encode(directions)
        h = torch.cat((points, directions, encoded, normals, features), dim=-1)
        for weight, bias in zip(self.color_weights[:-1], self.color_biases[:-1], strict=True):
            h = torch.relu(torch.addmm(bias, h, weight.T))
        return torch.sigmoid(torch.addmm(self.color_biases[-1], h, self.color_weights[-1].T))

    def tensors(self) -> dict[str, NDArray[Any]]:
        """The geometry's parameters by the safe format's names."""
        table = self.table.detach()
        tensors: dict[str, Tensor] = {"hash_table": table.half() if self.options.half_table else table}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"] = weight.detach(), bias.detach()
        return {name: tensor.cpu().numpy() for name, tensor in tensors.items()}


def _random_layers(widths: list[int], generator: torch.Generator) -> tuple[list[Tensor], list[Tensor]]:
    weights = [
        torch.randn(rows, columns, generator=generator) * math.sqrt(2.0 / rows)
        for columns, rows in itertools.pairwise(widths)
    ]
    return weights, [torch.zeros(len(weight)) for weight in weights]
