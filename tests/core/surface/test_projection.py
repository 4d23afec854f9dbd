"""Newton steps to the surface: exact for distances, bounded where the gradient is short."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from regnf_core.fields.observation import CountingField
from regnf_core.surface.result_clouds import newton_step, project_to_surface
from tests.core.analytic import sphere


def test_one_step_reaches_the_surface_of_an_exact_distance() -> None:
    ball = sphere(0.3)
    points = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    found = project_to_surface(ball.signed_distance_and_gradient, 0.5 * points, 1)
    torch.testing.assert_close(found.points, 0.3 * points, atol=1e-6, rtol=0)
    assert found.distance.abs().max() < 1e-6
    torch.testing.assert_close(found.gradient, points, atol=1e-5, rtol=0)


def test_each_step_and_the_end_evaluate_once() -> None:
    counting = CountingField(sphere(0.3))
    project_to_surface(counting.signed_distance_and_gradient, torch.full((7, 3), 0.3), 3)
    assert counting.evaluations == project_evaluations(4)


def project_evaluations(rounds: int) -> int:
    counting = CountingField(sphere(0.3))
    for _ in range(rounds):
        counting.signed_distance_and_gradient(torch.zeros(7, 3) + 0.1)
    return counting.evaluations


@pytest.mark.parametrize(("slope", "floor", "moved"), [(0.5, 0.5, 2.0), (0.1, 0.5, 0.4), (0.1, 0.01, 10.0)])
def test_a_short_gradient_counts_as_min_slope(slope: float, floor: float, moved: float) -> None:
    gradient = torch.tensor([[slope, 0.0, 0.0]])
    step = newton_step(torch.ones(1), gradient, floor)
    torch.testing.assert_close(step, torch.tensor([[moved, 0.0, 0.0]]))


def test_no_gradient_moves_nothing() -> None:
    def flat(points: Tensor) -> tuple[Tensor, Tensor]:
        return torch.ones(len(points)), torch.zeros_like(points)

    start = torch.rand(4, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(project_to_surface(flat, start, 2).points, start)
