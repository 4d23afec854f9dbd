"""A few hundred steps of Adam, towards a distance and its gradient."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from tests.core.importing.networks.shapes import Shape

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
) -> float:
    """Fit ``network``: (N, 3) to (N,). clamp: where DeepSDF cuts distances off. Returns the last loss of the values."""
    batch = 320
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(parameters, lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=0.02 * rate)
    last = 0.0
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
        (slope,) = torch.autograd.grad(target.sum(), points, retain_graph=False)
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
        last = float(loss.detach())
    return last
