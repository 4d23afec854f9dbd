"""Fields that are a network of plain layers and nothing else: NeuS, DeepSDF at one latent code, SIREN."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from regnf_core.fields.color_head import Appearance, ColorHead, PositionalEncoding
from regnf_core.fields.observation import OnDevice
from regnf_core.fields.user_fields import FunctionField
from regnf_core.schema.kinds import LEAKY_SLOPE, MlpDescription
from regnf_core.schema.tensor_check import count_layers

# What stands between the layers of a network, with its derivative.

_BETA = 100.0
_FLAT = 20.0
"""Beyond this |beta x| softplus is its asymptote to float32; cutting there also keeps denormal numbers out of exp."""


class _Softplus(torch.autograd.Function):
    """log(1 + exp(100 x)) / 100, about twice as fast on a CPU as the built-in one."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        tail = x.abs().mul_(-_BETA).clamp_min_(-_FLAT).exp_().add_(1.0).log_()
        return x.clamp_min(0.0).add_(tail, alpha=1.0 / _BETA)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *grad_outputs: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return grad_outputs[0] * softplus_slope(x)


def softplus(x: Tensor) -> Tensor:
    """log(1 + exp(100 x)) / 100, differentiable."""
    return _Softplus.apply(x)  # type: ignore[no-untyped-call, no-any-return]


def softplus_slope(x: Tensor) -> Tensor:
    """Derivative of :func:`softplus`."""
    return (x * _BETA).clamp_(-_FLAT, _FLAT).sigmoid_()


@dataclass(frozen=True)
class Activation:
    """A function of every number by itself, and its derivative."""

    value: Callable[[Tensor], Tensor]
    slope: Callable[[Tensor], Tensor]


def _gelu_slope(x: Tensor) -> Tensor:
    """Of x times the normal distribution's share below x."""
    below = 0.5 * (1.0 + torch.erf(x * math.sqrt(0.5)))
    return below + x * torch.exp(-0.5 * x.square()) / math.sqrt(2.0 * math.pi)


def _silu_slope(x: Tensor) -> Tensor:
    share = torch.sigmoid(x)
    return share * (1.0 + x * (1.0 - share))


def leaky_relu(negative_slope: float) -> Activation:
    """x above zero, ``negative_slope`` x below."""
    return Activation(
        lambda x: functional.leaky_relu(x, negative_slope),
        lambda x: torch.where(x > 0.0, 1.0, negative_slope).to(x.dtype),
    )


ACTIVATIONS = {
    "relu": Activation(torch.relu, lambda x: (x > 0.0).to(x.dtype)),
    "softplus": Activation(softplus, softplus_slope),
    "sine": Activation(torch.sin, torch.cos),
    "tanh": Activation(torch.tanh, lambda x: 1.0 - torch.tanh(x).square()),
    "elu": Activation(functional.elu, lambda x: x.clamp_max(0.0).exp()),
    "gelu": Activation(functional.gelu, _gelu_slope),
    "silu": Activation(functional.silu, _silu_slope),
    "leaky_relu": leaky_relu(LEAKY_SLOPE),
}
"""By the name that the safe format uses."""


@dataclass(frozen=True)
class LayerNorm(OnDevice):
    """(a - mean) / sqrt(variance + 1e-5) * weight + bias, over the last axis. weight, bias: (width,)."""

    weight: Tensor
    bias: Tensor

    def normalize(self, a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The result (N, width), and what :meth:`pull_back` needs: a standardized, and 1 / its deviation (N, 1)."""
        variance, mean = torch.var_mean(a, dim=-1, keepdim=True, correction=0)
        scale = (variance + 1e-5).rsqrt()
        standard = (a - mean) * scale
        return standard * self.weight + self.bias, standard, scale

    def pull_back(self, gradient: Tensor, standard: Tensor, scale: Tensor) -> Tensor:
        """Gradient (N, width) by a, from that by the result."""
        g = gradient * self.weight
        along = (g * standard).mean(dim=-1, keepdim=True)
        return scale * (g - g.mean(dim=-1, keepdim=True) - standard * along)


@dataclass(frozen=True)
class Layer(OnDevice):
    """W [h, input] + b, then perhaps a layer normalization. weight: (out, in), bias: (out,)."""

    weight: Tensor
    bias: Tensor
    sees_input: bool = False
    norm: LayerNorm | None = None


@dataclass(frozen=True)
class MlpFunction(OnDevice):
    """x -> [x, sines and cosines of x] -> layers, activation between -> tanh, ``output_tanh`` times -> distance.

    Of the last layer the first row is evaluated: the signed distance.
    """

    layers: tuple[Layer, ...]
    activation: Activation
    positional_encoding: PositionalEncoding | None = None
    output_tanh: int = 0
    head: ColorHead | None = None
    """The color, if there is one."""

    @property
    def device(self) -> torch.device:
        return self.layers[0].weight.device

    @property
    def has_color(self) -> bool:
        return self.head is not None

    def value(self, points: Tensor) -> Tensor:
        inputs = self._inputs(points)
        activate = self.activation.value
        h = inputs
        for layer in self.layers[:-1]:
            a = _linear(layer, h, inputs)
            h = activate(a if layer.norm is None else layer.norm.normalize(a)[0])
        return self._squashed(_linear(self.layers[-1], h, inputs).squeeze(-1))[0]

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        distance, gradient, _ = self._evaluated(points)
        return distance, gradient

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color (N, 3) at points (N, 3) along unit directions (N, 3)."""
        assert self.head is not None
        _, gradient, hidden = self._evaluated(points)
        return self.head(Appearance(points, gradient, hidden), directions)

    def _evaluated(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Signed distance (N,), its gradient (N, 3), and what the last layer is given (N, its columns)."""
        inputs = self._inputs(points)
        h, slopes, standards = inputs, [], []
        for layer in self.layers[:-1]:
            a = _linear(layer, h, inputs)
            if layer.norm is not None:
                a, standard, scale = layer.norm.normalize(a)
                standards.append((standard, scale))
            slopes.append(self.activation.slope(a))
            h = self.activation.value(a)
        distance, slope = self._squashed(_linear(self.layers[-1], h, inputs).squeeze(-1))
        gradient = slope.unsqueeze(-1) * self.layers[-1].weight  # (N, in)
        by_input, gradient = _split(self.layers[-1], gradient, inputs)
        for layer in reversed(self.layers[:-1]):
            gradient = gradient * slopes.pop()
            if layer.norm is not None:
                gradient = layer.norm.pull_back(gradient, *standards.pop())
            seen, gradient = _split(layer, gradient @ layer.weight, inputs)
            by_input = by_input + seen
        last = _with_input(self.layers[-1], h, inputs)
        return distance, self._pull_back(inputs, gradient + by_input), last

    def _inputs(self, points: Tensor) -> Tensor:
        if self.positional_encoding is None:
            return points
        return torch.cat((points, self.positional_encoding.encode(points)), dim=-1)

    def _pull_back(self, inputs: Tensor, gradient: Tensor) -> Tensor:
        if self.positional_encoding is None:
            return gradient
        return gradient[:, :3] + self.positional_encoding.pull_back(inputs[:, 3:], gradient[:, 3:])

    def _squashed(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """tanh, ``output_tanh`` times, and its derivative."""
        slope = torch.ones_like(distance)
        for _ in range(self.output_tanh):
            distance = distance.tanh()
            slope = slope * (1.0 - distance.square())
        return distance, slope


def build_mlp(
    description: MlpDescription, tensors: Mapping[str, Tensor], head: ColorHead | None = None
) -> FunctionField[MlpFunction]:
    """The field of ``description`` with its parameters in ``tensors`` (names as in the safe format), in float32.

    Tensors keep their device; they must have passed :meth:`MlpDescription.check_tensors`. Columns of sines and cosines
    that were never used are left out.
    """
    positional = PositionalEncoding.of(description.positional_encoding)
    live = 3 + (positional.width if positional is not None else 0)
    layers = []
    count = count_layers(tensors)
    for i in range(count):
        rows = slice(0, 1) if i == count - 1 else slice(None)
        weight, bias = (tensors[f"layers.{i}.{part}"][rows].float() for part in ("weight", "bias"))
        sees_input = i in description.input_at
        if i == 0 or sees_input:
            unused = description.input_width - live
            weight = weight[:, : weight.shape[1] - unused]
            if head is not None and i == count - 1:  # the color sees what this layer sees
                head = head.with_first(head.weights[0][:, : head.weights[0].shape[1] - unused])
        norm = None
        if i in description.normalized:
            norm = LayerNorm(tensors[f"norms.{i}.weight"].float(), tensors[f"norms.{i}.bias"].float())
        layers.append(Layer(weight, bias, sees_input, norm))
    activation = ACTIVATIONS[description.activation]
    if description.activation == "leaky_relu":
        activation = leaky_relu(description.negative_slope)
    function = MlpFunction(tuple(layers), activation, positional, description.output_tanh, head)
    return FunctionField(function, torch.tensor(description.function_bounds, dtype=torch.float64))


def _linear(layer: Layer, h: Tensor, inputs: Tensor) -> Tensor:
    return torch.addmm(layer.bias, _with_input(layer, h, inputs), layer.weight.T)


def _with_input(layer: Layer, h: Tensor, inputs: Tensor) -> Tensor:
    return torch.cat((h, inputs), dim=-1) if layer.sees_input else h


def _split(layer: Layer, gradient: Tensor, inputs: Tensor) -> tuple[Tensor, Tensor]:
    """What of the gradient by a layer's input belongs to the network's own input, and what to the layer before."""
    if not layer.sees_input:
        return torch.zeros_like(inputs), gradient
    hidden = gradient.shape[1] - inputs.shape[1]
    return gradient[:, hidden:], gradient[:, :hidden]
