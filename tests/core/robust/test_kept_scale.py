"""Stages that keep the poses' scales."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from regnf_core.robust.constants import SEARCH
from regnf_core.robust.model import model_object
from regnf_core.robust.pipeline import search_poses
from regnf_core.robust.problem import make_problem
from regnf_core.robust.scene import view_scene
from tests.core.analytic import chair, chair_pose, room
from tests.core.robust.shapes import ROBUST, detection

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
