"""Shapes whose distance is known in closed form, and a few hundred steps of Adam towards one and its gradient."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

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


Sampler = Callable[[int, torch.Generator], Tensor]


def in_ball(radius: float) -> Sampler:
    """Points of a ball, half of them near its middle."""

    def sample(count: int, generator: torch.Generator) -> Tensor:
        direction = torch.randn(count, 3, generator=generator)
        length = torch.rand(count, 1, generator=generator) ** (1 / 3)
        points: Tensor = radius * length * direction / direction.norm(dim=-1, keepdim=True)
        return points

    return sample


def in_cube(half: float) -> Sampler:
    """Points of a cube."""
    return lambda count, generator: half * (2.0 * torch.rand(count, 3, generator=generator) - 1.0)


def train(
    network: Callable[[Tensor], Tensor],
    parameters: list[nn.Parameter],
    shape: Shape,
    sample: Sampler,
    seed: int,
    steps: int = 300,
    rate: float = 1e-3,
    clamp: float | None = None,
) -> None:
    """Fit ``network``: (N, 3) to (N,). clamp: where DeepSDF cuts distances off."""
    batch = 320
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(parameters, lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=0.02 * rate)
    for _ in range(steps):
        points = sample(batch, generator)
        if clamp is not None:  # most near the surface, as its sampler has them
            near = points[: 3 * batch // 4].requires_grad_(True)
            distance = shape(near)
            (slope,) = torch.autograd.grad(distance.sum(), near)
            noise = 0.3 * clamp * torch.randn(len(near), 3, generator=generator)
            near = (near - distance[:, None] * slope).detach() + noise
            points = torch.cat((near, points[3 * batch // 4 :]))
        points = points.detach().requires_grad_(True)
        target = shape(points)
        (slope,) = torch.autograd.grad(target.sum(), points)
        target, slope = target.detach(), slope.detach()
        value = network(points)
        if clamp is not None:
            # beyond the clamp on the right side nothing is learned; on the wrong side, unlike DeepSDF, a little faster
            cut = target.clamp(-clamp, clamp)
            right = (value.abs() > clamp) & (cut.abs() == clamp) & (value * cut > 0.0)
            loss = torch.where(right, 0.0, (value - cut).abs()).mean()
        else:
            (found,) = torch.autograd.grad(value.sum(), points, create_graph=True)
            loss = (value - target).abs().mean() + 0.1 * (found - slope).norm(dim=-1).mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
