"""Sphere tracing: first crossings from free space into matter, against shapes whose surface is known."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.fields.observation import CountingField
from regnf_core.surface.sphere_tracing import Rays, first_hits
from tests.core.analytic import AnalyticField, boxes, sphere


def trace(field: AnalyticField, origins: list[list[float]], directions: list[list[float]]) -> tuple[Tensor, Tensor]:
    rays = Rays(torch.tensor(origins), torch.tensor(directions))
    count = len(origins)
    hits = first_hits(field, rays, torch.zeros(count), torch.full((count,), 3.0), 1e-3, 1e-4)
    order = hits.rays.argsort()
    return hits.points[order], hits.rays[order]


def test_first_hits_by_hand() -> None:
    ball = sphere(0.5)
    points, rays = trace(
        ball,
        [[2.0, 0, 0], [0, 2.0, 0.3], [0, 2.0, 0.6], [0.1, 0, 0]],
        [[-1.0, 0, 0], [0, -1.0, 0], [0, -1.0, 0], [1.0, 0, 0]],
    )
    # The third ray misses; the fourth starts inside matter and must not come out on the far side.
    assert rays.tolist() == [0, 1]
    torch.testing.assert_close(points, torch.tensor([[0.5, 0, 0], [0, 0.4, 0.3]]), rtol=0, atol=1e-5)


def test_the_visible_side_of_two_sheets_is_returned() -> None:
    sheets = boxes([([-1, -1, 0.3], [1, 1, 0.32]), ([-1, -1, -0.1], [1, 1, 0.0])])
    points, _ = trace(sheets, [[0.1, 0.2, 0.9]], [[0, 0, -1.0]])
    torch.testing.assert_close(points, torch.tensor([[0.1, 0.2, 0.32]]), rtol=0, atol=1e-4)


def test_a_field_that_is_no_distance_still_gives_its_zero() -> None:
    def warped(points: Tensor) -> Tensor:
        distance = points.norm(dim=-1) - 0.5
        return distance * (1.3 + 0.4 * (9 * points).sin().prod(-1))  # slopes of 0.9 to 1.7

    generator = torch.Generator().manual_seed(0)
    origins = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=1) * 1.5
    aims = torch.nn.functional.normalize(0.2 * torch.randn(200, 3, generator=generator) - origins, dim=1)
    field = AnalyticField(warped, [[-2, -2, -2], [2, 2, 2]])
    points, rays = trace(field, origins.tolist(), aims.tolist())
    assert len(rays) > 100
    assert float((points.norm(dim=1) - 0.5).abs().max()) < 2e-4
    towards = (points - origins[rays]).norm(dim=1)
    nearest = (origins[rays].norm(dim=1) - 0.5).min()
    assert float(towards.min()) >= float(nearest) - 1e-4
    assert bool((points * aims[rays]).sum(-1).lt(0.05).all())  # on the side that faces the camera


def test_rays_at_rest_are_not_evaluated_again() -> None:
    counted = CountingField(sphere(0.5))
    origins = torch.tensor([[0.51, 0.0, 0.0]]).repeat(1000, 1)
    origins[0] = torch.tensor([3.0, 0.0, 0.0])
    rays = Rays(origins, torch.tensor([[-1.0, 0.0, 0.0]]).expand(1000, 3))
    first_hits(counted, rays, torch.zeros(1000), torch.full((1000,), 4.0), 1e-3, 1e-4)
    assert counted.evaluations < 1000 * 30
