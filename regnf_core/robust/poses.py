"""Batches of poses: choosing, joining, perturbing and comparing similarity transforms (H,)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.sim3_tangent import matrix_from_quaternion


def select(T: Sim3, index: Tensor) -> Sim3:
    """The poses that ``index`` (numbers or bools) names, in its order."""
    return Sim3(T.scale[index], T.rotation[index], T.translation[index])


def join(batches: Sequence[Sim3]) -> Sim3:
    """All poses of several batches, one after the other."""
    return Sim3(
        torch.cat([T.scale.reshape(-1) for T in batches]),
        torch.cat([T.rotation.reshape(-1, 3, 3) for T in batches]),
        torch.cat([T.translation.reshape(-1, 3) for T in batches]),
    )


def perturb(T: Sim3, step: Tensor) -> Sim3:
    """s e^sigma, exp(omega) R, t + dt for steps (H, 7) = (omega, dt, sigma): a left perturbation that pivots on t."""
    omega, dt, sigma = step[..., :3], step[..., 3:6], step[..., 6]
    angle = omega.norm(dim=-1, keepdim=True)
    vector = 0.5 * torch.sinc(angle / (2 * torch.pi)) * omega
    turn = matrix_from_quaternion(torch.cat([vector, (angle / 2).cos()], dim=-1))
    return Sim3(T.scale * sigma.exp(), turn @ T.rotation, T.translation + dt)


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
    ranked = select(T, order)
    for rank in range(len(order)):
        if not open_[rank]:
            continue
        chosen.append(int(order[rank]))
        if len(chosen) == limit:
            break
        near = displacement(ranked, select(ranked, torch.tensor(rank)), points) < apart
        open_ &= ~near
    return torch.tensor(chosen, dtype=torch.long)
