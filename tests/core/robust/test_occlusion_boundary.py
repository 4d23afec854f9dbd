"""A scene observed from one side: its occlusion boundary is found, and unobserved places weigh little."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.robust.refine.loss import normal_equations, robust_cost
from regnf_core.robust.residuals import Residuals
from regnf_core.robust.scene import occlusion_boundary
from regnf_core.robust.working_frame import Samples


def unit(vectors: Tensor) -> Tensor:
    directions: Tensor = vectors / vectors.norm(dim=-1, keepdim=True)
    return directions


def edge_on_samples(viewpoint: Tensor, count: int, generator: torch.Generator) -> Samples:
    """Points on half planes through the viewpoint, normals at right angles to the lines of sight."""
    points = torch.rand(count, 3, generator=generator) - 0.5
    way = viewpoint - points
    normals = torch.linalg.cross(way, torch.randn(count, 3, generator=generator))
    return Samples(points, torch.zeros(count), unit(normals))


def test_edge_on_surface_is_told_from_surface_that_faces_the_viewpoint() -> None:
    generator = torch.Generator().manual_seed(0)
    viewpoint = torch.tensor([1.5, -0.4, 0.8])
    edge_on = edge_on_samples(viewpoint, 300, generator)
    points = torch.rand(400, 3, generator=generator) - 0.5
    normals = torch.nn.functional.normalize(
        torch.nn.functional.normalize(viewpoint - points, dim=-1) + 0.4 * torch.randn(400, 3, generator=generator),
        dim=-1,
    )
    facing = (normals * torch.nn.functional.normalize(viewpoint - points, dim=-1)).sum(-1) > 0.2
    both = Samples(
        torch.cat([edge_on.points, points[facing]]),
        torch.zeros(300 + int(facing.sum())),
        torch.cat([edge_on.normals, normals[facing]]),
    )
    found = occlusion_boundary(both, generator)[0]
    assert found[:300].float().mean() > 0.98
    assert found[300:].float().mean() < 0.02


def test_what_was_observed_from_all_sides_has_no_occlusion_boundary() -> None:
    generator = torch.Generator().manual_seed(0)
    normals = unit(torch.randn(800, 3, generator=generator))
    assert not occlusion_boundary(Samples(0.4 * normals, torch.zeros(800), normals), generator)[0].any()


def test_the_cost_of_unobserved_samples_and_its_slope() -> None:
    """The normal equations' right side is half the gradient of the cost, also where the kernel is narrower."""
    values = torch.tensor([[0.01, -0.02, -0.004, 0.03]], dtype=torch.float64)
    J = torch.randn(1, 4, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    unobserved = torch.tensor([[False, False, True, False]])
    width = 0.02

    def cost(step: Tensor) -> Tensor:
        return robust_cost(Residuals(values + (J @ step), J, torch.ones_like(values), 2, unobserved), width)[0]

    step = torch.zeros(7, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(cost(step), step)
    _, b = normal_equations(Residuals(values, J, torch.ones_like(values), 2, unobserved), width)
    torch.testing.assert_close(b[0] / width**2, gradient)
    seen = robust_cost(Residuals(values, J, torch.ones_like(values), 2), width)
    assert float(cost(torch.zeros(7).double())) < float(seen)
