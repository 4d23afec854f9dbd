"""Attempts in turn, a scale that is kept, an offset."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import register
from regnf_core.robust.constants import REFINEMENT, SEARCH, VERDICT
from regnf_core.robust.model import model_object
from regnf_core.robust.pipeline import search_poses
from regnf_core.robust.problem import make_problem
from regnf_core.robust.refine.levenberg_marquardt import Settings, minimize
from regnf_core.robust.refine.loss import normal_equations, robust_cost
from regnf_core.robust.residuals import Residuals, SurfacePair, residuals
from regnf_core.robust.scene import view_scene
from regnf_core.robust.search.distance_grid import feature_seeds
from regnf_core.robust.working_frame import sample_object_surface
from tests.core.analytic import AnalyticField, chair, chair_pose, room
from tests.core.robust.shapes import ROBUST, can, detection, placement_error, run

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
    result = register(room(chair_pose()), chair(), detection(), ROBUST, clouds=False)
    assert len(thorough) == more
    assert result.verdict == "registered"
    assert 0.95 < result.metrics["probability"] < 1.0
    assert placement_error(result, chair_pose()) < 0.005


def test_a_rejected_answer_is_searched_for_once_more(thorough: list[int]) -> None:
    assert register(room(chair_pose()), can(), detection(), ROBUST, clouds=False).verdict == "rejected"
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
    """The same field with its surface ``by`` units farther out."""
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
    assert free.residuals.offset is not None
    assert abs(float(without.T.scale / truth.scale) - 1.0) > 0.008
    assert abs(float(free.T.scale / truth.scale) - 1.0) < 0.002
    assert float(free.residuals.offset) == pytest.approx(0.015, abs=0.001)
    assert float(free.residuals.offset) <= REFINEMENT.max_offset


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
