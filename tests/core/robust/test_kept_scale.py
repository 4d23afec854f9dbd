"""Stages that keep the poses' scales."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import SEARCH
from regnf_core.robust.constants.model import Stage
from regnf_core.robust.fused.lock_step import all_coarse_to_fine
from regnf_core.robust.fused.parts import Sizes
from regnf_core.robust.model import model_object
from regnf_core.robust.pipeline import search_start
from regnf_core.robust.problem import RegistrationProblem, make_problem
from regnf_core.robust.refine.levenberg_marquardt import Descent, coarse_to_fine
from regnf_core.robust.scene import view_scene
from regnf_core.robust.search.bounds import ANY_SCALE, ScaleBounds
from tests.core.analytic import chair, chair_pose, room
from tests.core.robust.shapes import ROBUST, detection

STAGE = replace(SEARCH.stages[1], keep=8, min_distance=0.0)


def problem() -> RegistrationProblem:
    scene = room(chair_pose())
    view = view_scene(scene, detection(), ROBUST.robust)
    return make_problem(view, model_object(chair()), scene, chair(), ROBUST.robust)


def start() -> Descent:
    one = problem()
    truth = one.in_working_frames(chair_pose())
    steps = 0.05 * torch.randn(6, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    seeds = truth.expand(6).perturb(steps)
    return search_start(one.view, one.model, seeds, torch.Generator().manual_seed(0), one.bound)


@pytest.mark.parametrize("keeps", [True, False])
def test_scales_stay_where_the_stage_says_so(keeps: bool) -> None:
    begun = start()
    stage = replace(STAGE, keeps_scale=keeps)
    found = coarse_to_fine(begun.surfaces, begun.candidates, [stage], begun.context)
    before, after = begun.candidates.T.scale.sort().values, found.T.scale.sort().values
    assert torch.equal(before, after) == keeps
    assert not torch.equal(begun.candidates.T.translation.sort(0).values, found.T.translation.sort(0).values)


def test_many_pairs_at_once_keep_them_too() -> None:
    begun = [start(), start()]
    (found, other) = all_coarse_to_fine(begun, [STAGE], Sizes(2**24), lambda share: None)
    one_alone = start()
    alone = coarse_to_fine(one_alone.surfaces, one_alone.candidates, [STAGE], one_alone.context)
    for one in (found, other):
        assert not isinstance(one, Exception)
        assert torch.equal(one.T.scale.sort().values, begun[0].candidates.T.scale.sort().values)
        torch.testing.assert_close(one.T.matrix(), alone.T.matrix(), atol=1e-4, rtol=0.0)


def test_the_bound_of_poses_that_keep_their_scales_lets_none_grow() -> None:
    scales = torch.tensor([0.5, 2.0], dtype=torch.float64)
    T = Sim3(scales, torch.eye(3, dtype=torch.float64).expand(2, 3, 3), torch.zeros(2, 3, dtype=torch.float64))
    growth = torch.tensor([0.3, -0.2], dtype=torch.float64)
    assert ScaleBounds.same(T).limited_growth(scales, growth).tolist() == [0.0, 0.0]
    assert torch.equal(ANY_SCALE.limited_growth(scales, growth), growth)


def test_the_widest_stage_of_every_search_keeps_them() -> None:
    for stages in (SEARCH.stages, SEARCH.thorough_stages):
        moving: list[Stage] = [stage for stage in stages if stage.widths]
        assert [stage.keeps_scale for stage in moving] == [True] + [False] * (len(moving) - 1)
