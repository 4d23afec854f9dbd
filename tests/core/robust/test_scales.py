"""Attempts in turn, a scale that is kept, an offset."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from regnf_core.errors import InvalidOptionsError
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions, RobustOptions
from regnf_core.robust.constants import REFINEMENT, SEARCH, VERDICT
from regnf_core.robust.model import model_object
from regnf_core.robust.pipeline import search_poses
from regnf_core.robust.problem import make_problem
from regnf_core.robust.refine.levenberg_marquardt import Settings, minimize
from regnf_core.robust.refine.loss import normal_equations, robust_cost
from regnf_core.robust.residuals import Residuals, SurfacePair, residuals
from regnf_core.robust.scene import view_scene
from regnf_core.robust.search.bounds import ANY_SCALE, ScaleBound, seed_poses
from regnf_core.robust.search.distance_grid import feature_seeds
from regnf_core.robust.verdict.covariance import with_known_scale
from regnf_core.robust.working_frame import sample_object_surface
from tests.core.analytic import AnalyticField, chair, chair_pose, room
from tests.core.robust.shapes import ROBUST, can, detection, placement_error, random_pose, reframed, run

# How often a pose is searched for: once more where the first answer is rejected or leaves doubt.


@pytest.fixture
def thorough(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """One entry for each thorough search, of which feature matches are a part."""
    searches: list[int] = []

    def counted(*arguments: Any) -> Any:
        searches.append(1)
        return feature_seeds(*arguments)

    monkeypatch.setattr("regnf_core.robust.pipeline.feature_seeds", counted)
    return searches


@pytest.mark.parametrize(("doubtful", "more"), [(0.9, 0), (1.0, 1)])
def test_an_accepted_answer_that_leaves_doubt_is_searched_for_once_more(
    doubtful: float, more: int, thorough: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("regnf_core.robust.verdict.evaluation.VERDICT", replace(VERDICT, doubtful=doubtful))
    result = run(room(chair_pose()), chair(), detection())
    assert len(thorough) == more
    assert result.verdict == "registered"
    assert 0.95 < result.metrics["probability"] < 1.0
    assert placement_error(result, chair_pose()) < 0.005


def test_a_rejected_answer_is_searched_for_once_more(thorough: list[int]) -> None:
    assert run(room(chair_pose()), can(), detection()).verdict == "rejected"
    assert thorough == [1]


# Stages that keep the poses' scales.

STAGE = replace(SEARCH.stages[1], keep=8, min_distance=0.0)


@pytest.mark.parametrize("keeps", [True, False])
def test_scales_stay_where_the_stage_says_so(keeps: bool) -> None:
    scene = room(chair_pose())
    view = view_scene(scene, detection(), ROBUST.robust)
    one = make_problem(view, model_object(chair()), scene, chair(), ROBUST.robust)
    steps = 0.05 * torch.randn(6, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    seeds = one.in_working_frames(chair_pose()).expand(6).perturb(steps)
    stage = replace(STAGE, keeps_scale=keeps)
    found = search_poses(one.view, one.model, seeds, torch.Generator().manual_seed(0), one.bound, [stage])
    before, after = seeds.scale.sort().values, found.T.scale.sort().values
    assert torch.equal(before, after) == keeps
    assert not torch.equal(seeds.translation.sort(0).values, found.T.translation.sort(0).values)


# Surfaces too thick by the same everywhere: told from a larger scale, on exact fields.

D = torch.float64


def thickened(field: AnalyticField, by: float) -> AnalyticField:
    return AnalyticField(lambda points: field.formula(points) - by, field.bounds.tolist())


def some_residuals(offset: float) -> Residuals:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=D)

    values, jacobian = 0.01 * draw(1, 9), draw(1, 9, 7)
    return Residuals(values, jacobian, torch.ones(1, 9, dtype=D), 4, offset=torch.tensor([offset], dtype=D))


def test_the_offset_is_taken_out_of_both_directions() -> None:
    found = sample_object_surface(chair(), 300, torch.Generator().manual_seed(0))
    identity = Sim3(torch.ones(1, dtype=D), torch.eye(3, dtype=D)[None], torch.zeros(1, 3, dtype=D))
    surfaces = SurfacePair(found.field, found.field, found.samples, found.samples)
    plain = residuals(surfaces, identity)
    moved = residuals(surfaces, identity, torch.tensor([0.02], dtype=D))
    n = len(found.samples)
    torch.testing.assert_close(moved.values[:, :n], plain.values[:, :n] - 0.02)
    torch.testing.assert_close(moved.values[:, n:], plain.values[:, n:] + 0.02)
    torch.testing.assert_close(moved.jacobian, plain.jacobian)


def test_the_gradient_is_that_of_the_cost() -> None:
    # b is w^2 times the derivative of the robust cost: here by the offset, its prior included, by finite differences.
    width, h = 0.02, 1e-6

    def cost(offset: float) -> float:
        shift = offset - 0.003
        r = some_residuals(offset)
        values = r.values + r.jacobian_with_offset()[..., 7] * shift
        return float(robust_cost(Residuals(values, r.jacobian, r.cosines, 4, offset=r.offset), width))

    slope = (cost(0.003 + h) - cost(0.003 - h)) / (2 * h)
    _, b = normal_equations(some_residuals(0.003), width)
    assert float(b[0, 7]) == pytest.approx(slope * width**2, rel=1e-5)
    assert REFINEMENT.offset_prior > 0.0


def test_a_thick_copy_keeps_its_scale() -> None:
    generator = torch.Generator().manual_seed(0)
    target = sample_object_surface(chair(), 900, generator)
    by = 0.015 * target.frame.length
    source = sample_object_surface(thickened(chair(), by), 900, generator)
    truth = target.frame.to_field().inverse() @ source.frame.to_field()
    start = truth[None].perturb(torch.tensor([[0.03, -0.02, 0.02, 0.01, 0.01, -0.01, 0.04]], dtype=D))
    widths = [0.05, 0.04, 0.03, 0.02, *[0.01] * 8]
    surfaces = SurfacePair(source.field, target.field, source.samples, target.samples)
    without = minimize(surfaces, start, widths, Settings(widest=0.04))
    free = minimize(surfaces, start, widths, Settings(widest=0.04), offset=torch.zeros(1, dtype=D))
    assert free.offset is not None
    assert abs(float(without.T.scale / truth.scale) - 1.0) > 0.008
    assert abs(float(free.T.scale / truth.scale) - 1.0) < 0.002
    assert float(free.offset) == pytest.approx(0.015, abs=0.001)
    assert float(free.offset) <= REFINEMENT.max_offset


def rippled(field: AnalyticField, by: float, height: float) -> AnalyticField:
    """A rough field that is too thick: as fits to images are."""

    def formula(points: Tensor) -> Tensor:
        return field.formula(points) - by - height * (70.0 * points).sin().prod(-1)

    return AnalyticField(formula, field.bounds.tolist())


def test_a_thick_rough_scene_is_registered_at_its_scale_and_says_so() -> None:
    truth = chair_pose()
    result = run(rippled(room(truth), 0.012, 0.008), chair(), detection())
    assert result.verdict == "registered"
    assert float(result.T_object_scene.scale / truth.scale) == pytest.approx(1.0, abs=0.01)
    diameters = 0.012 * float(truth.scale) / result.metrics["object_diameter"]
    assert result.metrics["surface_offset"] == pytest.approx(diameters, abs=0.005)


# What the caller knows of the scale: by hand, against conditioning by linear algebra, and in whole registrations.


def numbers(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def between(low: float, high: float) -> RegistrationOptions:
    return RegistrationOptions(robust=RobustOptions(min_scale=low, max_scale=high, feature_draws=0))


def test_the_options_are_in_the_fields_units() -> None:
    bound = ScaleBound.of(RobustOptions(min_scale=0.5, max_scale=4.0), scene_length=3.0, object_length=2.0)
    assert (bound.low, bound.high) == (0.75, 6.0)
    assert bound.log_width == pytest.approx(math.log(8.0))
    assert ScaleBound.of(RobustOptions(), 3.0, 2.0) == ANY_SCALE
    assert ScaleBound.of(RobustOptions(min_scale=0.5), 3.0, 2.0) == ScaleBound(0.75, math.inf)
    assert ScaleBound.of(RobustOptions(max_scale=4.0), 3.0, 2.0) == ScaleBound(0.0, 6.0)


def test_changes_end_at_the_bound() -> None:
    bound = ScaleBound(0.5, 2.0)
    scale, growth = numbers(1.0, 1.0, 1.0, 2.0, 0.5), numbers(0.1, 3.0, -3.0, 0.1, 0.1)
    expected = numbers(0.1, math.log(2.0), -math.log(2.0), 0.0, 0.1)
    torch.testing.assert_close(bound.limited_growth(scale, growth), expected)
    torch.testing.assert_close(ANY_SCALE.limited_growth(scale, growth), growth)


def test_limited_poses_keep_the_objects_center_in_place() -> None:
    T = Sim3.cat([random_pose(seed, scale)[None] for seed, scale in ((1, 0.1), (2, 1.0), (3, 9.0))])
    limited = ScaleBound(0.5, 2.0).limited_poses(T)
    torch.testing.assert_close(limited.scale, numbers(0.5, 1.0, 2.0))
    center = torch.zeros(1, 3, dtype=torch.float64)
    torch.testing.assert_close(limited.inverse().apply(center), T.inverse().apply(center))
    torch.testing.assert_close(limited.rotation, T.rotation)


def test_seeds_of_one_scale_are_not_tried_twice() -> None:
    generator = torch.Generator().manual_seed(0)
    scene, obj = (torch.randn(50, 3, generator=generator) for _ in range(2))
    axes, rotations = torch.eye(3).double(), torch.eye(3).double()[None]
    factors = torch.tensor([0.8, 1.0, 1.25])
    free = seed_poses(scene, obj, axes, numbers(4, 4, 4), rotations, factors)
    fixed = seed_poses(scene, obj, axes, numbers(4, 4, 4), rotations, factors, ScaleBound(1.5, 1.5))
    assert (len(free), len(fixed)) == (5, 3), "by moments once instead of three times, by points and by the box"
    assert fixed.scale.tolist() == [1.5] * 3


@pytest.mark.parametrize("allowed", [1.0, 1.1])
def test_the_minimum_on_the_bound_is_that_of_the_poses_on_it(allowed: float) -> None:
    """From poses of another scale the steps go up to the bound; the minimum there is where steps of fixed scale end.
    Without normals: the cost is smooth, so there is one minimum. On the bound the kernels of both are equally wide:
    widths are those at the start, and stay the same in the scene."""
    generator = torch.Generator().manual_seed(0)
    target = sample_object_surface(chair(), 600, generator)
    surfaces = SurfacePair(target.field, target.field, target.samples, target.samples)
    step = torch.randn(6, 7, generator=generator, dtype=torch.float64) * numbers(*[0.05] * 3, *[0.02] * 3, 0.0)
    start = Sim3.identity().expand(6).perturb(step)
    larger = Sim3(torch.full_like(start.scale, 1.3), start.rotation, start.translation)
    widths = [0.2] * 25
    wider = [0.2 * 1.3 / allowed] * 25
    from_above = minimize(
        surfaces, larger, wider, Settings(scale=ScaleBound(allowed, 2.0), normals=False, with_history=True)
    )
    on_it = Sim3(torch.full_like(start.scale, allowed), start.rotation, start.translation)
    along = minimize(
        surfaces, on_it, widths, Settings(scale=ScaleBound(allowed, allowed), normals=False, with_history=True)
    )
    torch.testing.assert_close(along.T.scale, torch.full_like(start.scale, allowed))
    torch.testing.assert_close(from_above.T.scale, along.T.scale, atol=1e-4, rtol=0.0)
    assert from_above.history is not None
    assert along.history is not None
    costs = from_above.history.costs[:, -1], along.history.costs[:, -1]
    torch.testing.assert_close(*costs, atol=1e-5, rtol=1e-3)
    assert torch.all(along.T.translation.norm(dim=-1) < 0.02)


def test_the_covariance_is_that_of_a_measured_scale() -> None:
    generator = torch.Generator().manual_seed(0)
    half = torch.randn(7, 9, generator=generator, dtype=torch.float64)
    cov = half @ half.mT
    width = 0.3
    information = torch.linalg.inv(cov)
    information[6, 6] += 12.0 / width**2
    torch.testing.assert_close(with_known_scale(cov, width), torch.linalg.inv(information))
    assert with_known_scale(cov, math.inf) is cov
    fixed = with_known_scale(cov, 0.0)
    assert float(fixed[6, 6]) == pytest.approx(0.0, abs=1e-9)
    assert float(torch.linalg.eigvalsh(fixed)[0]) > 0.0
    torch.testing.assert_close(fixed[:6, :6], torch.linalg.inv(torch.linalg.inv(cov)[:6, :6]), atol=1e-8, rtol=1e-6)


def test_a_known_scale_is_kept_exactly() -> None:
    scene, obj, box, truth = reframed(random_pose(1, 1.0), random_pose(2, 12.0))
    scale = float(truth.scale)
    known = run(scene, obj, box, between(scale, scale))
    assert float(known.T_object_scene.scale) == pytest.approx(scale, rel=1e-12)
    assert known.verdict == "registered"
    assert placement_error(known, truth) < 0.002
    assert known.covariance is not None
    assert float(known.covariance[6, 6].sqrt()) < 1e-5
    assert float(torch.linalg.eigvalsh(known.covariance)[0]) > 0.0


def test_a_scale_that_is_not_the_true_one_is_not_registered() -> None:
    scene, obj, box, truth = reframed(random_pose(1, 1.0), random_pose(2, 1.0))
    wrong = 1.3 * float(truth.scale)
    result = run(scene, obj, box, between(wrong, wrong))
    assert float(result.T_object_scene.scale) == pytest.approx(wrong, rel=1e-12)
    assert result.verdict == "rejected"


def test_bounds_in_the_wrong_order() -> None:
    with pytest.raises(InvalidOptionsError, match=r"min_scale 2 is larger than max_scale 1"):
        RegistrationOptions.from_dict({"robust": {"min_scale": 2.0, "max_scale": 1.0}})
    with pytest.raises(ValueError, match="larger than"):
        RobustOptions(min_scale=2.0, max_scale=1.0)
    with pytest.raises(InvalidOptionsError, match="min_scale"):
        RegistrationOptions.from_dict({"robust": {"min_scale": 0.0}})
