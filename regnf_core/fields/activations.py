"""What stands between the layers of a network, with its derivative."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from regnf_core.schema.kinds.mlp import LEAKY_SLOPE

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
