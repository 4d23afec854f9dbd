"""How far apart poses place an object, and the best poses of a batch that are distinct by this measure."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3


def displacement(T: Sim3, reference: Sim3, points: Tensor) -> Tensor:
    """Largest distance, target units, between the images of the object points (N, 3) under T^-1 and one reference^-1.

    (H,): how far apart two poses place the object, measured in the frame it is placed in and scaled to its own units.
    """
    placed, other = T.inverse().apply(points.double()), reference.inverse().apply(points.double())
    apart: Tensor = reference.scale * (placed - other).norm(dim=-1).amax(-1)
    return apart


def distinct(T: Sim3, scores: Tensor, points: Tensor, apart: float, limit: int) -> Tensor:
    """Numbers of the best poses (lowest score first), no two of which place ``points`` closer together than ``apart``.

    points: (N, 3) of the object; a handful of its extreme points is enough.
    """
    order = scores.argsort()
    chosen: list[int] = []
    open_ = torch.ones(len(order), dtype=torch.bool)
    ranked = T[order]
    for rank in range(len(order)):
        if not open_[rank]:
            continue
        chosen.append(int(order[rank]))
        if len(chosen) == limit:
            break
        near = displacement(ranked, ranked[rank], points) < apart
        open_ &= ~near
    return torch.tensor(chosen, dtype=torch.long)
