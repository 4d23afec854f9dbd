"""The normals in the refinement's loss: surface that faces another way does not attract."""

from __future__ import annotations

import pytest
import torch

from regnf_core.geometry.metrics import displacement
from regnf_core.robust.constants import REFINEMENT, SEARCH
from regnf_core.robust.refine.levenberg_marquardt import Settings, minimize
from regnf_core.robust.refine.loss import disagreement, normal_equations, robust_cost
from regnf_core.robust.residuals import Residuals, SurfacePair
from regnf_core.robust.working_frame import sample_object_surface
from tests.core.analytic import boxes, union

D = torch.float64


def residuals_with(cosines: list[float], step: torch.Tensor | None = None) -> Residuals:
    """Of five samples, two of them the scene's, moved by a step (7,) of the pose; their cosines do not change."""
    generator = torch.Generator().manual_seed(0)
    values = 0.02 * torch.randn(1, 5, generator=generator, dtype=D)
    J = torch.randn(1, 5, 7, generator=generator, dtype=D)
    moved = values if step is None else values + J @ step
    return Residuals(moved, J, torch.tensor([cosines], dtype=D), 2)


@pytest.mark.parametrize("normals", [True, False])
def test_the_normal_equations_are_the_gradient_of_the_cost_at_fixed_normals(normals: bool) -> None:
    cosines, width = [0.9, 0.2, -0.7, 1.0, 0.5], 0.03
    step = torch.zeros(7, dtype=D, requires_grad=True)
    (gradient,) = torch.autograd.grad(robust_cost(residuals_with(cosines, step), width, normals).sum(), step)
    _, b = normal_equations(residuals_with(cosines), width, normals)
    torch.testing.assert_close(b[0] / width**2, gradient)


def test_a_sample_that_faces_away_costs_the_most_and_pulls_nothing() -> None:
    width = 0.03
    H, b = normal_equations(residuals_with([-0.1] * 5), width)
    assert float(H.abs().max()) == 0.0
    assert float(b.abs().max()) == 0.0
    assert robust_cost(residuals_with([-0.1] * 5), width).tolist() == [1.0]


def test_where_all_was_observed_the_cost_is_the_score() -> None:
    r, width = residuals_with([0.9, 0.2, -0.7, 1.0, 0.5]), 0.03
    torch.testing.assert_close(robust_cost(r, width), disagreement(r, width))
    without = robust_cost(r, width, normals=False)
    assert float(without) < float(robust_cost(r, width))


def test_an_object_is_not_drawn_to_surface_that_faces_it() -> None:
    """A block beside a wall, 8 % of its diameter away. Without normals it moves by 7 %, in six steps with the widest
    kernel."""
    block = boxes([([-0.2, -0.15, -0.3], [0.2, 0.15, 0.3])])
    wall = boxes([([0.26, -0.3, -0.4], [0.9, 0.3, 0.4])])
    target = sample_object_surface(block, 600, torch.Generator().manual_seed(0))
    scene = sample_object_surface(union([block, wall]), 3000, torch.Generator().manual_seed(1))
    inner = scene.frame.to_field().apply(scene.samples.points.double())[:, 0] < 0.3
    surfaces = SurfacePair(scene.field, target.field, scene.samples[inner.nonzero().squeeze(-1)], target.samples)
    truth = target.frame.to_field().inverse() @ scene.frame.to_field()
    off = {}
    for normals in (True, False):
        found = minimize(surfaces, truth[None], [0.15] * 6, Settings(normals=normals)).T
        off[normals] = float(displacement(found, truth, target.samples.points)[0])
    assert off[True] < 0.005
    assert off[False] > 0.03


def test_the_last_stages_alone_leave_them_out() -> None:
    """Their cost is smooth: at a crease the nearest surface, and with it the normal, changes from place to place."""
    assert all(stage.normals for stage in (*SEARCH.stages, *SEARCH.thorough_stages, *REFINEMENT.stages))
    assert not any(stage.normals for stage in REFINEMENT.last_stages)
