"""A network of softplus layers without a graph: each feature is a plane, one long row of all points.

With a layer's result called a, what the next layer is fed is 100 softplus(a) = max(z, 0) + log(1 + exp(-|z|)), where
z = 100 a. Both factors are part of the weights, as is the bias: every input has a last row of ones. With
p = sigmoid(z), the slope, the logarithm is -log max(p, 1 - p): one exponential gives the value and the slope.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

_BETA = 100.0
_FLAT = 20.0
"""Beyond this |z| softplus is its asymptote to float32; cutting there also keeps denormal numbers out of exp."""


class PlaneNetwork:
    """weights[i]: (out_i, in_i), biases[i]: (out_i,); of the last layer one row. Made in microseconds."""

    def __init__(self, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> None:
        self._layers = []
        for number, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            fed = weight.detach() / _BETA if number else weight.detach()
            both = torch.cat((fed, bias.detach()[:, None]), dim=1)
            self._layers.append(both if number == len(weights) - 1 else both * _BETA)
        self._back = [layer[:, :-1].T.contiguous() for layer in self._layers]

    def value(self, inputs: Tensor) -> Tensor:
        """Signed distance (N,) of inputs (in + 1, N), whose last row holds ones."""
        h = inputs
        for layer in self._layers[:-1]:
            h, _ = _activated(layer, h)
        return (self._layers[-1] @ h)[0]

    def with_gradient(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """The same, and its gradient (in, N) by the inputs without the row of ones."""
        h, slopes = inputs, []
        for layer in self._layers[:-1]:
            h, slope = _activated(layer, h)
            slopes.append(slope)
        distance = (self._layers[-1] @ h)[0]
        gradient = self._back[-1]
        for layer in reversed(self._back[:-1]):
            gradient = layer @ slopes.pop().mul_(gradient)
        return distance, gradient.expand(-1, inputs.shape[1])


def _activated(layer: Tensor, inputs: Tensor) -> tuple[Tensor, Tensor]:
    """What the next layer is fed (out + 1, N), with a row of ones, and the slopes (out, N) of the activation."""
    fed = torch.empty(len(layer) + 1, inputs.shape[1])
    z = torch.mm(layer, inputs, out=fed[:-1])
    fed[-1] = 1.0
    slope = z.clamp(-_FLAT, _FLAT).sigmoid_()
    larger = 1.0 - slope
    torch.maximum(larger, slope, out=larger).log_()
    z.clamp_min_(0.0).sub_(larger)
    return fed, slope
