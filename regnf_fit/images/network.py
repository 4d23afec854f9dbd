"""The parameters of a field that is being fitted to images: geometry, color and the opacity's sharpness."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from regnf_core.fields.positional_encoding import PositionalEncoding
from regnf_fit.images.options import ReconstructionOptions
from regnf_fit.network import StartShape, TrainableField, random_layers

DIRECTION_DEGREE = 4
COLOR_INPUTS = 3 + (3 + 6 * DIRECTION_DEGREE) + 3
"""Point, direction with its sines and cosines, normal; the geometry's feature follows."""
_COLOR_LAYERS = 2


class RadianceField(TrainableField):
    """A trainable field with colors.

    The color's network has the same inputs as that of neus-facto, in its order: point, direction, normal, feature.
    """

    options: ReconstructionOptions

    def __init__(self, options: ReconstructionOptions, start: StartShape, generator: torch.Generator) -> None:
        super().__init__(options, start, generator)
        self._direction_encoding = PositionalEncoding(DIRECTION_DEGREE)
        width = options.hidden_width
        feature = torch.randn(options.feature_width, width, generator=generator) * math.sqrt(1.0 / width)
        self.feature_weight = nn.Parameter(feature)
        self.feature_bias = nn.Parameter(torch.zeros(options.feature_width))
        widths = [COLOR_INPUTS + options.feature_width] + [width] * _COLOR_LAYERS + [3]
        weights, biases = random_layers(widths, generator)
        self.color_weights, self.color_biases = nn.ParameterList(weights), nn.ParameterList(biases)
        self.background = nn.Parameter(torch.zeros(3))
        """Logit of the color behind everything."""
        self.log_sharpness = nn.Parameter(torch.zeros(()))
        """Logarithm of the sharpness over the least one that the schedule allows."""

    def feature(self, hidden: Tensor) -> Tensor:
        """The feature (N, F) that the color depends on, of what the geometry's last layer is given (N, H)."""
        return torch.addmm(self.feature_bias, hidden, self.feature_weight.T)

    def color(self, points: Tensor, directions: Tensor, normals: Tensor, features: Tensor) -> Tensor:
        """Color (N, 3) in [0, 1] of points seen along unit ``directions`` (N, 3)."""
        encoded = self._direction_encoding.encode(directions)
        h = torch.cat((points, directions, encoded, normals, features), dim=-1)
        for weight, bias in zip(self.color_weights[:-1], self.color_biases[:-1], strict=True):
            h = torch.relu(torch.addmm(bias, h, weight.T))
        return torch.sigmoid(torch.addmm(self.color_biases[-1], h, self.color_weights[-1].T))
