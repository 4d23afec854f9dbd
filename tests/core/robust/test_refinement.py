"""The refinement."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from torch import Tensor

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
from regnf_core.robust.working_frame import Samples, sample_object_surface, subsample
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
    history = minimize(surfaces, start, [0.05] * 6, Settings(with_history=True)).history
    assert history is not None
    costs = [before, *history.costs.T]
    assert all((later <= earlier + 1e-7).all() for earlier, later in pairwise(costs))


def _bounds_behind(T: Sim3) -> list[list[float]]:
    corners = torch.cartesian_prod(*[torch.tensor([-0.6, 0.6], dtype=torch.float64)] * 3)
    seen = T.inverse().apply(corners)
    return [seen.amin(0).tolist(), seen.amax(0).tolist()]


# The derivatives of the residuals as lengths of the scene, by two routes, in several frames and at several scales.


class Quadric:
    """A smooth, curved made-up distance in float64, so that derivatives can be compared to many digits."""

    def __init__(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.M = torch.randn(3, 3, generator=generator, dtype=torch.float64)
        self.b = torch.randn(3, generator=generator, dtype=torch.float64)

    def value(self, points: Tensor) -> Tensor:
        return (points @ self.M).sin().sum(-1) + points @ self.b

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        gradient = (points @ self.M).cos() @ self.M.T + self.b
        return self.value(points), gradient


def samples(field: Quadric, seed: int) -> Samples:
    points = torch.randn(9, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    value, gradient = field.value_and_gradient(points)
    return Samples(points, value, gradient / gradient.norm(dim=-1, keepdim=True))


def plain_residuals(scene: Quadric, obj: Quadric, A: Samples, B: Samples, T: Sim3) -> Tensor:
    """The definition, written out once more: S_b(T x) - s S_a(x), then s S_a(T^-1 z) - S_b(z)."""
    scene_to_object = obj.value(T.apply(A.points)) - T.scale * scene.value(A.points)
    object_to_scene = T.scale * scene.value(T.inverse().apply(B.points)) - obj.value(B.points)
    return torch.cat([scene_to_object, object_to_scene])


@pytest.mark.parametrize(("scale", "frame"), [(0.05, 0), (1.0, 1), (20.0, 2)])
def test_the_jacobian_is_what_autograd_says(scale: float, frame: int) -> None:
    scene, obj, T = Quadric(frame), Quadric(frame + 10), random_pose(frame, scale)
    A, B = samples(scene, 3), samples(obj, 4)

    def moved(step: Tensor) -> Tensor:
        p = T[None].perturb(step[None])
        in_object = plain_residuals(scene, obj, A, B, Sim3(p.scale[0], p.rotation[0], p.translation[0]))
        return in_object / p.scale[0] * T.scale

    expected = torch.autograd.functional.jacobian(moved, torch.full((7,), 1e-12, dtype=torch.float64))
    found = residuals(SurfacePair(scene, obj, A, B), T[None])
    torch.testing.assert_close(found.values[0], plain_residuals(scene, obj, A, B, T), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found.jacobian[0], expected, rtol=1e-6, atol=1e-6)


def test_true_pose_leaves_no_residual_off_the_surface_at_any_scale() -> None:
    scene, T = Quadric(0), random_pose(5, 7.0)

    class SeenFromObject:
        def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
            value, gradient = scene.value_and_gradient(T.inverse().apply(points))
            return T.scale * value, gradient @ T.rotation.T

    obj = SeenFromObject()
    A = samples(scene, 1)
    z = T.apply(A.points)
    value, gradient = obj.value_and_gradient(z)
    B = Samples(z, value, gradient / gradient.norm(dim=-1, keepdim=True))
    found = residuals(SurfacePair(scene, obj, A, B), T[None])
    assert found.values.abs().max() < 1e-9
    torch.testing.assert_close(found.cosines, torch.ones_like(found.cosines))


# The scale of what was seen from one side: neither the units of the residuals nor what was hidden makes it larger.


NOISE = 0.02
CAP = 0.6
"""Height of the seen cap of a sphere of radius 1."""


class Ball:
    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        length = points.norm(dim=-1)
        return length - 1.0, points / length[:, None]


def cap(count: int, seed: int, noise: float) -> Samples:
    """Samples of the cap about the z axis, off the sphere by the noise; they are taken to lie on the surface."""
    generator = torch.Generator().manual_seed(seed)
    z = 1.0 - CAP * torch.rand(count, generator=generator, dtype=D)
    turn = 2 * torch.pi * torch.rand(count, generator=generator, dtype=D)
    ring = (1 - z**2).sqrt()
    normals = torch.stack([ring * turn.cos(), ring * turn.sin(), z], 1)
    off = noise * torch.randn(count, generator=generator, dtype=D)
    return Samples(normals * (1 + off)[:, None], torch.zeros(count, dtype=D), normals)


def closed_form_radius(points: Tensor) -> float:
    """The sphere through points (N, 3) with the least squares of distances in their own frame: Gauss-Newton on center
    and radius, nothing of the engine's."""
    center, radius = torch.zeros(3, dtype=D), torch.ones((), dtype=D)
    for _ in range(50):
        arm = points - center
        length = arm.norm(dim=1)
        J = torch.cat([-arm / length[:, None], -torch.ones(len(points), 1, dtype=D)], 1)
        step = torch.linalg.lstsq(J, -(length - radius)[:, None]).solution[:, 0]
        center, radius = center + step[:3], radius + step[3]
    return float(radius)


def _silent() -> Samples:
    """A sample of the object that faces the other way than all surface does, and so weighs nothing."""
    top = torch.tensor([[0.0, 0.0, 1.0]], dtype=D)
    return Samples(top, torch.zeros(1, dtype=D), -top)


def test_the_scale_is_that_of_least_squares_in_the_scene() -> None:
    """One direction alone, where least squares can be solved by another route: the sphere through noisy points."""
    radii, found = [], []
    for seed in range(8):
        scene = cap(400, seed, NOISE)
        T = minimize(SurfacePair(Ball(), Ball(), scene, _silent()), Sim3.identity()[None], [5.0] * 60).T
        radii.append(closed_form_radius(scene.points))
        found.append(float(1.0 / T.scale))
    torch.testing.assert_close(torch.tensor(found), torch.tensor(radii), rtol=2e-3, atol=0.0)


def test_the_frames_and_their_units_do_not_matter() -> None:
    """A scene in other units, and turned, leads to the same size of the object in it."""
    scene, turned = cap(400, 5, NOISE), random_pose(1, 7.0)
    S = Sim3(turned.scale, turned.rotation, torch.zeros(3, dtype=D))
    objects = cap(200, 6, 0.0)

    class Moved:
        def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
            value, gradient = Ball().value_and_gradient(S.inverse().apply(points))
            return S.scale * value, gradient @ S.rotation.T

    moved = Samples(S.apply(scene.points), scene.values, scene.normals @ S.rotation.T)
    widths = [0.1] * 30
    here = minimize(SurfacePair(Ball(), Ball(), scene, objects), Sim3.identity()[None], widths).T
    there = minimize(SurfacePair(Moved(), Ball(), moved, objects), S.inverse()[None], widths).T
    assert float(there.scale * S.scale) == pytest.approx(float(here.scale), rel=1e-6)


def partly_observed() -> Residuals:
    """Of seven samples, three of them the scene's; one of the four of the object was observed."""
    generator = torch.Generator().manual_seed(0)
    values = 0.02 * torch.randn(1, 7, generator=generator, dtype=D)
    J = torch.randn(1, 7, 7, generator=generator, dtype=D)
    unobserved = torch.tensor([[False, False, True, False, True, True, True]])
    return Residuals(values, J, torch.ones(1, 7, dtype=D), 3, unobserved)


def test_observed_samples_weigh_as_if_all_had_been_observed() -> None:
    """One of four was: what it adds to J^T W J, written out once more, counts four times."""
    r, width = partly_observed(), 0.03
    weight = observed_weight(r)
    assert weight is not None
    assert weight.tolist() == [[4.0]]
    weighted, _ = normal_equations(r, width, weight=weight)
    plain, _ = normal_equations(r, width)
    J, value = r.jacobian[0, 3], r.values[0, 3]
    one = J[:, None] * J[None] / (1 + (value / width) ** 2) ** 2 / 4
    torch.testing.assert_close((weighted - plain)[0], 3 * one)


def test_where_next_to_nothing_was_observed_the_weight_is_bounded() -> None:
    r = partly_observed()
    hidden = Residuals(r.values, r.jacobian, r.cosines, 3, torch.ones(1, 7, dtype=torch.bool))
    assert observed_weight(hidden).tolist() == [[1.0 / REFINEMENT.min_observed_share]]  # type: ignore[union-attr]
    everything = Residuals(r.values, r.jacobian, r.cosines, 3)
    assert observed_weight(everything) is None
