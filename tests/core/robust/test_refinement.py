"""The refinement."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch

from regnf_core.geometry.metrics import displacement
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import REFINEMENT, SEARCH
from regnf_core.robust.refine.levenberg_marquardt import Settings, minimize
from regnf_core.robust.refine.loss import disagreement, normal_equations, observed_weight, robust_cost
from regnf_core.robust.residuals import (
    Residuals,
    SurfacePair,
    geman_mcclure_agreement,
    geman_mcclure_curvature,
    geman_mcclure_loss,
    geman_mcclure_weight,
    residuals,
)
from regnf_core.robust.working_frame import sample_object_surface, subsample
from tests.core.analytic import boxes, chair, seen_from, union
from tests.core.robust.shapes import random_pose

# The normals in the refinement's loss: surface that faces another way does not attract.

D = torch.float64


WIDTH = 0.03
COSINES = [0.9, 0.2, -0.7, 1.0, 0.5]


def residuals_with(
    cosines: list[float] = COSINES, step: torch.Tensor | None = None, unobserved: list[bool] | None = None
) -> Residuals:
    """Of five samples, two of them the scene's, moved by a step (7,) of the pose; their cosines do not change."""
    generator = torch.Generator().manual_seed(0)
    values = 0.02 * torch.randn(1, 5, generator=generator, dtype=D)
    J = torch.randn(1, 5, 7, generator=generator, dtype=D)
    moved = values if step is None else values + J @ step
    return Residuals(
        moved, J, torch.tensor([cosines], dtype=D), 2, None if unobserved is None else torch.tensor([unobserved])
    )


@pytest.mark.parametrize("normals", [True, False])
@pytest.mark.parametrize("unobserved", [None, [False, True, False, True, True]])
def test_the_normal_equations_are_the_gradient_of_the_cost_at_fixed_normals(
    normals: bool, unobserved: list[bool] | None
) -> None:
    """Also where kernels are narrower and weights are larger, because a part was not observed."""
    r = residuals_with(unobserved=unobserved)
    weight = observed_weight(r)
    step = torch.zeros(7, dtype=D, requires_grad=True)
    cost = robust_cost(residuals_with(step=step, unobserved=unobserved), WIDTH, normals, weight)
    (gradient,) = torch.autograd.grad(cost.sum(), step)
    _, b = normal_equations(r, WIDTH, normals, weight)
    torch.testing.assert_close(b[0] / WIDTH**2, gradient)
    if unobserved is not None:
        assert float(robust_cost(r, WIDTH, normals)) < float(robust_cost(residuals_with(), WIDTH, normals))


def test_a_sample_that_faces_away_costs_the_most_and_pulls_nothing() -> None:
    H, b = normal_equations(residuals_with([-0.1] * 5), WIDTH)
    assert float(H.abs().max()) == float(b.abs().max()) == 0.0
    assert robust_cost(residuals_with([-0.1] * 5), WIDTH).tolist() == [1.0]


def test_where_all_was_observed_the_cost_is_the_score() -> None:
    r = residuals_with()
    torch.testing.assert_close(robust_cost(r, WIDTH), disagreement(r, WIDTH))
    assert float(robust_cost(r, WIDTH, normals=False)) < float(robust_cost(r, WIDTH))


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


# Convergence of the batched Levenberg-Marquardt from perturbed starts, on exact fields.


def test_weight_and_curvature_are_the_derivatives_of_the_loss() -> None:
    r, width = torch.tensor([0.0, 0.02, 0.1, 0.25], dtype=torch.float64, requires_grad=True), 0.1
    loss = geman_mcclure_loss(r, width)
    torch.testing.assert_close(loss + geman_mcclure_agreement(r, width), torch.ones_like(r))
    (slope,) = torch.autograd.grad(loss.sum(), r, create_graph=True)
    weight = geman_mcclure_weight(r, width)
    torch.testing.assert_close(slope, 2 * weight * r / width**2)
    (bend,) = torch.autograd.grad(slope.sum(), r)
    torch.testing.assert_close(2 / width**2 * geman_mcclure_curvature(r, width, weight), bend)


@pytest.mark.parametrize("scale", [0.1, 10.0])
def test_many_perturbed_starts_come_back_at_once(scale: float) -> None:
    truth = random_pose(3, scale)
    generator = torch.Generator().manual_seed(0)
    target = sample_object_surface(chair(), 800, generator)
    seen = seen_from(chair(), truth, _bounds_behind(truth))
    source = sample_object_surface(seen, 800, generator)
    T_work = target.frame.to_field().inverse() @ truth @ source.frame.to_field()
    step = torch.randn(24, 7, generator=generator, dtype=torch.float64) * torch.tensor([0.12] * 3 + [0.04] * 3 + [0.08])
    start = T_work.expand(24).perturb(step)
    A, B = subsample(source.samples, 300, generator), subsample(target.samples, 300, generator)
    surfaces = SurfacePair(source.field, target.field, A, B)
    refined = minimize(surfaces, start, [0.1, 0.1, 0.08, 0.06, 0.04, 0.03, 0.02, 0.01, 0.01, 0.01])
    left = displacement(refined.T, T_work, target.samples.points)
    assert displacement(start, T_work, target.samples.points).median() > 0.1
    assert left.median() < 1e-4
    assert (left < 1e-3).float().mean() >= 0.9


def test_no_iteration_raises_the_cost() -> None:
    generator = torch.Generator().manual_seed(1)
    target = sample_object_surface(chair(), 400, generator)
    start = Sim3.identity().expand(5).perturb(0.2 * torch.randn(5, 7, generator=generator, dtype=torch.float64))
    surfaces = SurfacePair(target.field, target.field, target.samples, target.samples)
    before = robust_cost(residuals(surfaces, start), 0.05)
    costs = [before]
    minimize(surfaces, start, [0.05] * 6, on_iteration=lambda done: costs.append(done.costs))
    assert all((later <= earlier + 1e-7).all() for earlier, later in pairwise(costs))


def _bounds_behind(T: Sim3) -> list[list[float]]:
    corners = torch.cartesian_prod(*[torch.tensor([-0.6, 0.6], dtype=torch.float64)] * 3)
    seen = T.inverse().apply(corners)
    return [seen.amin(0).tolist(), seen.amax(0).tolist()]
