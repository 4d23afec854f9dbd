"""A short training to a shape's distances: enough that the weights look like a trainer's."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from benchmarks.trainer_runs.shapes import Shape

_BATCH = 1024
_REACH = 1.0


def train(
    value: Callable[[Tensor], Tensor],
    parameters: Sequence[Tensor],
    shape: Shape,
    rng: np.random.Generator,
    steps: int,
    learning_rate: float = 2e-3,
    clamp: float | None = None,
) -> float:
    """Adam on |value - distance|, half of the points near the surface. Returns the last error."""
    optimizer = torch.optim.Adam(parameters, lr=learning_rate)
    generator = torch.Generator().manual_seed(int(rng.integers(1 << 31)))
    error = torch.tensor(0.0)
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * min(1.0, 2.0 * (1 - step / steps))
        points = _points(shape, generator)
        target = shape(points)
        found = value(points)
        if clamp is not None and step > steps // 2:  # nothing would draw a first guess beyond the clamp to the surface
            found, target = found.clamp(-clamp, clamp), target.clamp(-clamp, clamp)
        error = (found - target).abs().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    return float(error.detach())


def _points(shape: Shape, generator: torch.Generator) -> Tensor:
    points = (torch.rand(2 * _BATCH, 3, generator=generator) * 2 - 1) * _REACH
    near = points[shape(points).abs().argsort()[: _BATCH // 2]]
    return torch.cat((points[: _BATCH // 2], near + 0.02 * torch.randn(near.shape, generator=generator)))
