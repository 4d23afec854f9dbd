"""Shapes whose distance is known in closed form, to train small networks on."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

Shape = Callable[[Tensor], Tensor]
"""Points (N, 3) to signed distances (N,), negative inside."""


def random_shape(rng: np.random.Generator, size: float = 1.0) -> Shape:
    """One of a few solids within the ball of radius ``size``: size, place and rotation are random."""
    rotation = torch.from_numpy(np.linalg.qr(rng.normal(size=(3, 3)))[0]).float()
    center = torch.from_numpy(rng.uniform(-0.1, 0.1, 3)).float() * size
    solid = (_box, _torus, _capsule, _two_balls)[int(rng.integers(4))]
    dimensions = torch.from_numpy(rng.uniform(0.6, 1.0, 3)).float() * size

    def distance(points: Tensor) -> Tensor:
        kept = (rotation.to(points), center.to(points), dimensions.to(points))
        value: Tensor = solid((points - kept[1]) @ kept[0], kept[2])
        return value

    return distance


def _box(x: Tensor, d: Tensor) -> Tensor:
    q = x.abs() - 0.45 * d
    value: Tensor = q.clamp_min(0.0).norm(dim=-1) + q.amax(dim=-1).clamp_max(0.0) - 0.08 * d[0]
    return value


def _torus(x: Tensor, d: Tensor) -> Tensor:
    ring = x[:, :2].norm(dim=-1) - 0.5 * d[0]
    value: Tensor = torch.stack((ring, x[:, 2]), dim=-1).norm(dim=-1) - 0.22 * d[1]
    return value


def _capsule(x: Tensor, d: Tensor) -> Tensor:
    along = x[:, 0].clamp(-0.4 * d[0], 0.4 * d[0])
    nearest = torch.stack((along, torch.zeros_like(along), torch.zeros_like(along)), dim=-1)
    value: Tensor = (x - nearest).norm(dim=-1) - 0.3 * d[1]
    return value


def _two_balls(x: Tensor, d: Tensor) -> Tensor:
    offset = x.new_tensor([0.3, 0.1, 0.0]) * d[0]
    return torch.minimum((x - offset).norm(dim=-1) - 0.35 * d[1], (x + offset).norm(dim=-1) - 0.3 * d[2])
