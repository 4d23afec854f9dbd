"""Random solids with a closed form of their distance, within the unit ball."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

Shape = Callable[[Tensor], Tensor]


def random_shape(rng: np.random.Generator) -> Shape:
    """The union of one to four balls, boxes and tori; exact outside, a bound inside where they overlap."""
    parts = [_part(rng) for _ in range(int(rng.integers(1, 5)))]
    return lambda x: torch.stack([part(x) for part in parts]).amin(dim=0)


def _part(rng: np.random.Generator) -> Shape:
    center = torch.tensor(rng.uniform(-0.3, 0.3, 3), dtype=torch.float64)
    kind = rng.choice(["ball", "box", "torus"])
    if kind == "ball":
        radius = rng.uniform(0.15, 0.4)
        return lambda x: (x - center.to(x)).norm(dim=1) - radius
    if kind == "box":
        half = torch.tensor(rng.uniform(0.1, 0.35, 3), dtype=torch.float64)
        return lambda x: _box(x - center.to(x), half.to(x))
    ring, tube = rng.uniform(0.2, 0.4), rng.uniform(0.06, 0.15)
    return lambda x: _torus(x - center.to(x), ring, tube)


def _box(x: Tensor, half: Tensor) -> Tensor:
    q = x.abs() - half
    return q.clamp_min(0).norm(dim=1) + q.amax(dim=1).clamp_max(0)


def _torus(x: Tensor, ring: float, tube: float) -> Tensor:
    around = torch.stack((x[:, :2].norm(dim=1) - ring, x[:, 2]), dim=1)
    return around.norm(dim=1) - tube
