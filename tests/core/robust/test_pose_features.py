"""Features of poses by hand: exact agreement, a known gap, hidden and free samples, stiffness by differences."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.robust.model import model_object
from regnf_core.robust.problem import RegistrationProblem, make_problem
from regnf_core.robust.residuals import residuals
from regnf_core.robust.scene import view_scene
from regnf_core.robust.verdict.evidence import SPEAKS_FOR, pose_features
from tests.core.analytic import chair, chair_pose, room
from tests.core.robust.shapes import detection

OPTIONS = RegistrationOptions().robust
NO_OFFSET = torch.zeros(1, dtype=torch.float64)


@pytest.fixture(scope="module")
def problem() -> RegistrationProblem:
    """A chair in a room, both exact."""
    scene, obj = room(chair_pose()), chair()
    view = view_scene(scene, detection(), OPTIONS)
    return make_problem(view, model_object(obj, OPTIONS), scene, obj, OPTIONS)


def features_at(problem: RegistrationProblem, T: Sim3) -> dict[str, float]:
    found = pose_features(problem, T[None], residuals(problem.held_out, T[None], NO_OFFSET), NO_OFFSET)
    assert list(found) == list(SPEAKS_FOR)
    return {name: float(values[0]) for name, values in found.items()}


def truth(problem: RegistrationProblem) -> Sim3:
    return problem.in_working_frames(chair_pose())


def test_the_right_pose_agrees_in_all_respects(problem: RegistrationProblem) -> None:
    found = features_at(problem, truth(problem))
    for name in ("object_agrees", "object_agrees_coarsely", "confirmed", "hull_explained", "confirmed_patches"):
        assert found[name] > 0.95, name  # normals are arbitrary at edges
    for name in ("seen_through", "free", "matter_inside", "unexplained", "hidden"):
        assert found[name] < 0.01, name
    assert found["noise"] < 0.005
    assert found["covered_patches"] == 1.0


def test_every_feature_gets_worse_far_away(problem: RegistrationProblem) -> None:
    """The object a third of its diameter beside its place."""
    right, T = features_at(problem, truth(problem)), truth(problem)
    wrong = features_at(problem, replace(T, translation=T.translation + torch.tensor([0.33, 0.0, 0.0]).double()))
    for name in ("object_agrees", "scene_agrees", "confirmed", "confirmed_patches", "free", "seen_through", "noise"):
        assert (wrong[name] < right[name]) == SPEAKS_FOR[name], name


def test_shares_by_a_slow_count(problem: RegistrationProblem) -> None:
    T = truth(problem).perturb(torch.tensor([0.1, 0.0, 0.05, 0.03, -0.02, 0.04, 0.1], dtype=torch.float64))
    found = features_at(problem, T)
    r = residuals(problem.held_out, T[None], NO_OFFSET)
    to_object, to_scene = r.scene_to_object[0].tolist(), r.object_to_scene[0].tolist()
    near = [value for value in to_object if abs(value) <= 0.1]
    assert found["scene_agrees"] == pytest.approx(sum(abs(value) <= 0.02 for value in near) / len(near))
    assert found["matter_inside"] == pytest.approx(sum(value < -0.03 for value in near) / len(near))
    visible = [value for value in to_scene if abs(value) <= 0.03 or value > 0]
    assert found["hidden"] == pytest.approx(1 - len(visible) / len(to_scene))
    assert found["free"] == pytest.approx(sum(value > 0.04 for value in visible) / len(visible))
    assert found["object_agrees"] == pytest.approx(sum(abs(value) <= 0.02 for value in visible) / len(visible))


def test_an_offset_counts_either_way(problem: RegistrationProblem) -> None:
    T = truth(problem)[None]
    for offset in (-0.02, 0.02):
        off = torch.tensor([offset], dtype=torch.float64)
        assert float(pose_features(problem, T, residuals(problem.held_out, T, off), off)["offset"][0]) == 0.02


def test_stiffness_by_finite_differences(problem: RegistrationProblem) -> None:
    """No small motion of unit length on the object's surface changes the agreeing residuals by less than it says."""
    T = truth(problem)
    found = features_at(problem, T)
    r = residuals(problem.held_out, T[None], NO_OFFSET)
    n = r.scene_count
    near = r.scene_to_object[0].abs() <= 0.1
    weights = torch.zeros(r.values.shape[1])
    weights[:n] = ((r.scene_to_object[0].abs() <= 0.03) & near) / near.sum()
    weights[n:] = (r.object_to_scene[0].abs() <= 0.03) / (r.values.shape[1] - n)
    points = problem.held_out.object_samples.points.double()
    step = 1e-3
    least = float("inf")
    for motion in torch.randn(300, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64):
        moved = T.perturb(step * motion)
        back = T.inverse().apply(points)
        length = (moved.apply(back) - points).square().sum(-1).mean().sqrt()
        change = (residuals(problem.held_out, moved[None], NO_OFFSET).values - r.values)[0]
        least = min(least, float((0.5 * (weights * change.square()).sum()).sqrt() / length))
    assert 0.0 < found["stiffness"] <= found["second_stiffness"]
    assert found["stiffness"] <= least * 1.02
    assert least < 3.0 * found["stiffness"]


def test_nothing_agrees_far_away(problem: RegistrationProblem) -> None:
    T = truth(problem)
    found = features_at(problem, replace(T, translation=T.translation + 5.0))
    assert all(value == value for value in found.values())
    assert found["confirmed"] == 0.0
    assert found["stiffness"] == 0.0


def test_a_pose_of_extreme_scale_far_away_has_features_too(problem: RegistrationProblem) -> None:
    T = truth(problem)
    for scale, distance in ((1e-6, 1e-6), (1e6, 1e8), (1.0, 1e8)):
        found = features_at(problem, replace(T, scale=T.scale * scale, translation=T.translation + distance))
        assert all(value == value for value in found.values())
