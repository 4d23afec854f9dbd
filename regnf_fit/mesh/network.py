"""The parameters of a field that is being fitted."""

from __future__ import annotations

import itertools
import math
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from regnf_core.fields.geometry_mlp import GeometryMlp
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.neus_facto import NeusFactoFunction
from regnf_core.fields.positional_encoding import PositionalEncoding
from regnf_fit.mesh.options import FitOptions

DEGREE = 6
_TABLE_SPREAD = 1e-4


class TrainableField(nn.Module):
    """A neus-facto field with trainable table and layers, starting as roughly a sphere of ``radius``.

    The start is the geometric initialization of Atzmon and Lipman (2020, "SAL"): it gives a signed distance from the
    first iteration on.
    """

    def __init__(self, options: FitOptions, radius: float, generator: torch.Generator) -> None:
        super().__init__()
        self.options = options
        grid = options.grid
        table = torch.rand(grid.entries, grid.features_per_level, generator=generator)
        self.table = nn.Parameter((2.0 * table - 1.0) * _TABLE_SPREAD)
        encoding = PositionalEncoding(DEGREE)
        widths = [3 + encoding.width + grid.width] + [options.hidden_width] * options.hidden_layers
        weights, biases = [], []
        for columns, rows in itertools.pairwise(widths):
            weights.append(torch.randn(rows, columns, generator=generator) * math.sqrt(2.0 / rows))
            biases.append(torch.zeros(rows))
        weights[0][:, 3 : 3 + encoding.width] = 0.0
        weights.append(torch.full((1, widths[-1]), math.sqrt(math.pi / widths[-1])))
        biases.append(torch.full((1,), -radius))
        self.weights = nn.ParameterList(weights)
        self.biases = nn.ParameterList(biases)
        self._encoding = encoding

    def function(self) -> NeusFactoFunction:
        """The field's function of the present parameters, differentiable with respect to them."""
        mlp = GeometryMlp(list(self.weights), list(self.biases))
        return NeusFactoFunction(mlp, self._encoding, HashEncoding(self.options.grid, self.table))

    def tensors(self) -> dict[str, NDArray[Any]]:
        """The parameters by the safe format's names."""
        table = self.table.detach()
        tensors: dict[str, Tensor] = {"hash_table": table.half() if self.options.half_table else table}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"] = weight.detach(), bias.detach()
        return {name: tensor.numpy() for name, tensor in tensors.items()}
