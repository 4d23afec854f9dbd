"""A few outermost points of an object, by which two placements of it are compared."""

from __future__ import annotations

import torch
from torch import Tensor


def extremal_points(points: Tensor, count: int) -> Tensor:
    """``count`` of the points (N, 3), far apart from each other: farthest-point sampling from the outermost one."""
    chosen = [int((points - points.mean(0)).norm(dim=-1).argmax())]
    nearest = torch.full((points.shape[0],), torch.inf, dtype=points.dtype)
    for _ in range(min(count, points.shape[0]) - 1):
        nearest = torch.minimum(nearest, (points - points[chosen[-1]]).norm(dim=-1))
        chosen.append(int(nearest.argmax()))
    return points[chosen]
