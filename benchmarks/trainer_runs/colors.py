"""The trainers' color networks in plain torch, from their published formulas: random, slow, in double precision."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import lpmv
from torch import Tensor

from benchmarks.trainer_runs.run import ColorFunction, normalized

Outputs = Callable[[Tensor], Tensor]
"""All results (N, 1 + F) of the geometry's network at points (N, 3), the distance first."""


@dataclass(frozen=True)
class ColorLayers:
    """Linear layers with ReLU between."""

    weights: list[Tensor]
    biases: list[Tensor]

    def __call__(self, inputs: Tensor) -> Tensor:
        hidden = inputs
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = hidden @ weight.double().T + bias.double()
            hidden = hidden.clamp_min(0) if i < len(self.weights) - 1 else hidden
        return hidden

    def state(self, rng: np.random.Generator, name: str, normal: bool = True, step: int = 1) -> dict[str, Tensor]:
        """As a trainer saves them: ``name`` and the layer's number."""
        state = {}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            factors = torch.tensor(rng.uniform(0.5, 2, len(weight)), dtype=torch.float32)
            parts = normalized(weight, factors) if normal else {"weight": weight}
            state |= {f"{name}{step * i}.{part}": value for part, value in parts.items()}
            state[f"{name}{step * i}.bias"] = bias
        return state


def random_layers(rng: np.random.Generator, inputs: int, width: int, hidden: int) -> ColorLayers:
    """``hidden`` layers of ``width``, then three numbers."""
    widths = [inputs, *[width] * hidden, 3]
    weights = [
        torch.tensor(rng.normal(0, math.sqrt(2 / before), (after, before)), dtype=torch.float32)
        for before, after in itertools.pairwise(widths)
    ]
    return ColorLayers(weights, [torch.tensor(rng.normal(0, 0.1, len(w)), dtype=torch.float32) for w in weights])


def color_function(outputs: Outputs, combine: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]) -> ColorFunction:
    """``combine`` of points, directions, the distance's gradient and all results, clamped as a color is."""

    def color(points: Tensor, directions: Tensor) -> Tensor:
        at = points.double().clone().requires_grad_()
        found = outputs(at)
        (gradient,) = torch.autograd.grad(found[:, 0].sum(), at)
        return combine(at.detach(), directions.double(), gradient, found.detach()).clamp(0, 1)

    return color


def harmonics(directions: Tensor, degree: int) -> Tensor:
    """(N, degree^2): real spherical harmonics with the Condon-Shortley sign, by associated Legendre functions."""
    x, y, z = directions.double().numpy().T
    around = np.arctan2(y, x)
    columns = []
    for order in range(degree):
        for m in range(-order, order + 1):
            k = abs(m)
            scale = (2 * order + 1) / (4 * math.pi) * math.factorial(order - k) / math.factorial(order + k)
            part = math.sqrt(scale) * lpmv(k, order, z)
            wave = math.sqrt(2) * (np.cos(k * around) if m > 0 else np.sin(k * around)) if m else 1.0
            columns.append(part * wave)
    return torch.tensor(np.stack(columns, axis=1))


def flat_state(layers: ColorLayers, inputs: int) -> Tensor:
    """A fully fused network's vector: inputs filled up with ones, outputs with what nobody reads, no biases.

    The weights of what fills the inputs up act as the first layer's bias, which they become in ``layers``.
    """
    rows = [weight.clone() for weight in layers.weights]
    ones = torch.linspace(-1, 1, len(rows[0]))[:, None].expand(-1, -inputs % 16)
    rows[0] = torch.cat((rows[0], ones), dim=1)
    layers.biases[0] += ones.sum(dim=1)
    rows[-1] = torch.cat((rows[-1], torch.ones(-len(rows[-1]) % 16, rows[-1].shape[1])))
    return torch.cat([weight.reshape(-1) for weight in rows])


def joined(parts: Sequence[Tensor]) -> Tensor:
    """Columns side by side, in double precision."""
    return torch.cat([part.double() for part in parts], dim=1)
