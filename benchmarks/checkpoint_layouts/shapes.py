"""Random solids as exact or nearly exact signed distances, to train small fields on."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Shape = Callable[[Tensor], Tensor]


def random_shape(generator: torch.Generator) -> Shape:
    """The union of three to six balls, boxes and rings within [-0.8, 0.8]^3: distances (N,) of points (N, 3)."""
    count = int(torch.randint(3, 7, (1,), generator=generator))
    parts = [_part(generator) for _ in range(count)]

    def distance(points: Tensor) -> Tensor:
        return torch.stack([part(points) for part in parts]).amin(dim=0)

    return distance


def _part(generator: torch.Generator) -> Shape:
    center = 0.8 * torch.rand(3, generator=generator) - 0.4
    size = 0.12 + 0.25 * torch.rand(3, generator=generator)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator))
    kind = int(torch.randint(0, 3, (1,), generator=generator))

    def ball(local: Tensor) -> Tensor:
        return local.norm(dim=-1) - size[0]

    def box(local: Tensor) -> Tensor:
        beyond = local.abs() - size
        return beyond.clamp_min(0.0).norm(dim=-1) + beyond.amax(dim=-1).clamp_max(0.0)

    def ring(local: Tensor) -> Tensor:
        radial = local[:, :2].norm(dim=-1) - size[0]
        return torch.hypot(radial, local[:, 2]) - 0.4 * size[0]

    formula = (ball, box, ring)[kind]
    return lambda points: formula((points - center) @ turn)
