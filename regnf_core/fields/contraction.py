"""The contraction that squeezes all of space into the cube [-2, 2]^3, in the infinity norm (Barron et al. 2022)."""

from __future__ import annotations

import torch
from torch import Tensor


def contract_linf(points: Tensor) -> Tensor:
    """Points (N, 3) with |x|_inf >= 1 moved to (2 - 1/|x|_inf) x/|x|_inf, the others unchanged."""
    norm = points.abs().amax(dim=-1, keepdim=True).clamp_min(1.0)
    return points * ((2.0 - 1.0 / norm) / norm)


def pull_back_linf(points: Tensor, gradient: Tensor) -> Tensor:
    """Gradient (N, 3) with respect to the points (N, 3), from the one (N, 3) with respect to the contracted points.

    With m = |x|_inf and c(m) = 2/m - 1/m^2 the contraction is c x and its Jacobian c I + c'(m) sign(x_j) x e_j^T,
    where j is the largest axis.
    """
    largest, axis = points.abs().max(dim=-1, keepdim=True)
    m = largest.clamp_min(1.0)
    slope = torch.where(largest >= 1.0, (2.0 / m - 2.0) / (m * m), torch.zeros_like(m))  # c'(m)
    along = slope * (points * gradient).sum(dim=-1, keepdim=True) * points.gather(-1, axis).sign()
    return (gradient * ((2.0 - 1.0 / m) / m)).scatter_add(-1, axis, along)
