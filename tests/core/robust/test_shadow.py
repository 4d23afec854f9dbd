"""A scene seen from one side: its shadow is told from its surface, and what is unseen weighs little."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.robust.refine.levenberg_marquardt import normal_equations, robust_cost
from regnf_core.robust.residuals import Residuals, Samples
from regnf_core.robust.scene.occlusion_boundary import shadow_walls


def unit(vectors: Tensor) -> Tensor:
    directions: Tensor = vectors / vectors.norm(dim=-1, keepdim=True)
    return directions


def wall_samples(viewpoint: Tensor, count: int, generator: torch.Generator) -> Samples:
    """Points on half planes through the viewpoint, normals at right angles to the lines of sight."""
    points = torch.rand(count, 3, generator=generator) - 0.5
    way = viewpoint - points
    normals = torch.linalg.cross(way, torch.randn(count, 3, generator=generator))
    return Samples(points, torch.zeros(count), unit(normals))


def test_walls_are_told_from_what_faces_the_viewpoint() -> None:
    generator = torch.Generator().manual_seed(0)
    viewpoint = torch.tensor([1.5, -0.4, 0.8])
    walls = wall_samples(viewpoint, 300, generator)
    points = torch.rand(400, 3, generator=generator) - 0.5
    normals = torch.nn.functional.normalize(
        torch.nn.functional.normalize(viewpoint - points, dim=-1) + 0.4 * torch.randn(400, 3, generator=generator),
        dim=-1,
    )
    facing = (normals * torch.nn.functional.normalize(viewpoint - points, dim=-1)).sum(-1) > 0.2
    both = Samples(
        torch.cat([walls.points, points[facing]]),
        torch.zeros(300 + int(facing.sum())),
        torch.cat([walls.normals, normals[facing]]),
    )
    found = shadow_walls(both, generator)
    assert found[:300].float().mean() > 0.98
    assert found[300:].float().mean() < 0.02


def test_what_was_seen_from_all_round_has_no_shadow() -> None:
    generator = torch.Generator().manual_seed(0)
    normals = unit(torch.randn(800, 3, generator=generator))
    assert not shadow_walls(Samples(0.4 * normals, torch.zeros(800), normals), generator).any()


def test_the_cost_of_unseen_samples_and_its_slope() -> None:
    """The normal equations' right side is half the gradient of the cost, also where the kernel is narrower."""
    values = torch.tensor([[0.01, -0.02, -0.004, 0.03]], dtype=torch.float64)
    J = torch.randn(1, 4, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    unseen = torch.tensor([[False, False, True, False]])
    width = 0.02

    def cost(step: Tensor) -> Tensor:
        return robust_cost(Residuals(values + (J @ step), J, torch.ones_like(values), 2, unseen), width)[0]

    step = torch.zeros(7, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(cost(step), step)
    _, b = normal_equations(Residuals(values, J, torch.ones_like(values), 2, unseen), width)
    torch.testing.assert_close(b[0] / width**2, gradient)
    seen = robust_cost(Residuals(values, J, torch.ones_like(values), 2), width)
    assert float(cost(torch.zeros(7).double())) < float(seen)
