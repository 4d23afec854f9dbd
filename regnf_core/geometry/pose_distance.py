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

    points: (N, 3) of the object; a handful of its extreme points is enough. One pose decides on the next: that is done
    on the CPU, whatever device T (H,) and scores (H,) are on; the numbers (K,) are on the CPU too.
    """
    T, scores, points = T.on("cpu"), scores.cpu(), points.cpu()
    order = scores.argsort()
    placed = T[order].inverse().apply(points.double()).mT.contiguous()  # (H, 3, N)
    reach = (apart / T.scale[order].double()).square().tolist()
    numbers: list[int] = order.tolist()
    chosen: list[int] = []
    left = torch.arange(len(order))
    while len(left) and len(chosen) < limit:
        best, others = int(left[0]), placed[1:]
        chosen.append(numbers[best])
        squares = (others - placed[0]).square().sum(1).amax(-1)
        far = (~(squares < reach[best])).nonzero().squeeze(-1)
        left, placed = left[1:][far], others[far]
    return torch.tensor(chosen, dtype=torch.long)
