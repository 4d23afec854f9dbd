"""A handful of outermost points by which two placements of an object can be told apart."""

from __future__ import annotations

import torch
from torch import Tensor


def extreme_points(points: Tensor, count: int) -> Tensor:
    """``count`` of the points (N, 3), far apart from each other: farthest-point sampling from the outermost one."""
    chosen = [int((points - points.mean(0)).norm(dim=-1).argmax())]
    nearest = torch.full((points.shape[0],), torch.inf, dtype=points.dtype)
    for _ in range(min(count, points.shape[0]) - 1):
        nearest = torch.minimum(nearest, (points - points[chosen[-1]]).norm(dim=-1))
        chosen.append(int(nearest.argmax()))
    return points[chosen]
