"""What the verdict rests on."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.robust.constants import EVIDENCE, VERDICT
from regnf_core.robust.model import model_object
from regnf_core.robust.problem import RegistrationProblem, make_problem
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.residuals import SurfacePair, residuals
from regnf_core.robust.scene import view_scene
from regnf_core.robust.verdict.answer import LEAD, Answer, choose, pose_odds
from regnf_core.robust.verdict.evidence import SPEAKS_FOR, coverage, pose_features, unexplained_samples, worst_place
from regnf_core.robust.working_frame import Samples
from tests.core.analytic import boxes, chair, chair_pose, room, union
from tests.core.robust.shapes import detection

# How much of the object the agreement covers: patches counted by hand, and against a slow count.

CENTERS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]])


def about(counts: list[int]) -> torch.Tensor:
    """So many points at each of the centers, a little beside it."""
    return torch.repeat_interleave(CENTERS, torch.tensor(counts), dim=0) + torch.tensor([0.1, 0.2, 0.0])


def test_patches_by_hand() -> None:
    """Two poses. Three of ten samples confirm a patch, two do not; five scene samples cover it, four do not."""
    mine, theirs = about([10, 10, 10, 10]), about([5, 4, 0, 9])
    confirmed = torch.zeros(2, 40, dtype=torch.bool)
    confirmed[0, [0, 1, 2, 10, 11, 30, 31, 32, 33]] = True
    near = torch.ones(2, 18, dtype=torch.bool)
    near[1, :5] = False
    found = coverage(CENTERS, mine, theirs.expand(2, -1, -1), confirmed, near)
    assert found["confirmed_patches"].tolist() == [0.5, 0.0]
    assert found["covered_patches"].tolist() == [0.5, 0.25]


@pytest.mark.parametrize("seed", [0, 1])
def test_against_a_slow_count(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    centers, mine = torch.randn(16, 3, generator=generator), torch.randn(300, 3, generator=generator)
    theirs = torch.randn(3, 200, 3, generator=generator)
    confirmed = torch.rand(3, 300, generator=generator) < 0.3
    near = torch.rand(3, 200, generator=generator) < 0.4
    found = coverage(centers, mine, theirs, confirmed, near)
    for pose in range(3):
        members: list[list[int]] = [[] for _ in centers]
        for number, point in enumerate(mine):
            members[min(range(16), key=lambda k: float((point - centers[k]).norm()))].append(number)
        shown = [0] * 16
        for number, point in enumerate(theirs[pose]):
            shown[min(range(16), key=lambda k: float((point - centers[k]).norm()))] += bool(near[pose, number])
        agreeing = [sum(bool(confirmed[pose, number]) for number in patch) for patch in members]
        enough = [a >= EVIDENCE.min_confirmed_in_patch * len(patch) for a, patch in zip(agreeing, members, strict=True)]
        assert float(found["confirmed_patches"][pose]) == pytest.approx(sum(enough) / 16)
        covered = sum(count >= EVIDENCE.min_samples_in_patch for count in shown)
        assert float(found["covered_patches"][pose]) == pytest.approx(covered / 16)


# Surface joined to an object, told from that of things close by: a table top, and slabs on it or above it.

UP = torch.tensor([0.0, 0.0, 1.0])


class Floor:
    """Matter below ``height``; above x = 5 below ``right``."""

    def __init__(self, height: float, right: float) -> None:
        self.height, self.right = height, right

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        top = torch.where(points[:, 0] > 5.0, self.right, self.height)
        return points[:, 2] - top, UP.expand_as(points)


def samples(*rows: tuple[float, float, float]) -> Samples:
    """(x, height, whether it faces up or down) each."""
    points = torch.tensor([[x, 0.0, z] for x, z, _ in rows])
    normals = torch.stack([UP * facing for _, _, facing in rows])
    return Samples(points, torch.zeros(len(rows)), normals)


def share(A: Samples, right: float) -> float:
    """Of the samples near the plane z = 0 as object, in a scene whose matter reaches to ``right`` above x = 5."""
    return share_of(SurfacePair(Floor(0.0, right), Floor(0.0, 0.0), A, A), Sim3.identity()[None])


def share_of(surfaces: SurfacePair, T: Sim3) -> float:
    heights = T[0].apply(surfaces.scene_samples.points)[:, 2]
    near = heights.abs() <= 0.1
    found = unexplained_samples(surfaces, T, (near & (heights > 0.03))[None])[0]
    assert not bool((found & ~near).any())
    return float(found.sum() / near.sum().clamp_min(1))


ON = tuple((float(x), 0.0, 1.0) for x in range(5))
ACROSS = (*((float(x), 0.0, 1.0) for x in range(8)), (6.0, 0.06, -1.0), (7.0, 0.06, -1.0))


@pytest.mark.parametrize(
    ("rows", "right", "expected"),
    [
        # what lies on the object; the last is too far off to be near
        ((*ON, (6.0, 0.06, 1.0), (7.0, 0.06, 1.0), (8.0, 0.5, 1.0)), 0.06, 2 / 7),
        (ACROSS, 0.0, 0.0),  # what faces the object across a gap
        (ACROSS, 0.06, 0.2),  # the same, but what it faces is not there
        (((0.0, 0.029, 1.0), (1.0, -0.06, 1.0), (2.0, 0.031, 1.0)), 0.0, 1 / 3),  # only what is asked about
        (((0.0, 3.0, 1.0),), 0.0, 0.0),  # nothing is near
    ],
)
def test_what_is_unexplained_by_hand(rows: Any, right: float, expected: float) -> None:
    assert share(samples(*rows), right) == pytest.approx(expected)


def test_it_is_the_same_in_every_frame() -> None:
    A = samples(*ON, (6.0, 0.06, 1.0))
    T = Sim3.from_quaternion(2.0, [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
    half = Samples(A.points / 2.0, A.values, A.normals)

    class Halved(Floor):
        def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
            value, gradient = super().value_and_gradient(2.0 * points)
            return value / 2.0, gradient

    surfaces = SurfacePair(Halved(0.0, 0.06), Floor(0.0, 0.0), half, half)
    found = share_of(surfaces, T[None])
    assert found == pytest.approx(1 / 6)
    assert share(A, 0.06) == pytest.approx(1 / 6)


# Features of poses by hand: exact agreement, a known gap, hidden and free samples, stiffness by differences.

OPTIONS = RegistrationOptions().robust
NO_OFFSET = torch.zeros(1, dtype=torch.float64)


@pytest.fixture(scope="module")
def problem() -> RegistrationProblem:
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


def test_a_pose_of_extreme_scale_far_away_has_features_too(problem: RegistrationProblem) -> None:
    T = truth(problem)
    for scale, distance in ((1e-6, 1e-6), (1e6, 1e8), (1.0, 1e8)):
        found = features_at(problem, replace(T, scale=T.scale * scale, translation=T.translation + distance))
        assert all(value == value for value in found.values())
    assert (found["confirmed"], found["stiffness"]) == (0.0, 0.0), "nothing agrees far away"


# The answer among candidates that are placed by hand: who wins, who is listed, and how likely they are.

LONG = ([-0.4, -0.1, -0.1], [0.4, 0.1, 0.1])
"""A long box: turned half about an upright axis it is the same, moved along its length by .05 nearly so."""
OBSERVED = SimpleNamespace(of_thing=False)
GOOD = {name: 1.0 if better else 0.0 for name, better in SPEAKS_FOR.items()}


def answer(
    shifts: list[float], scores: list[float], observation: object | None = OBSERVED, **changed: list[float]
) -> Answer:
    """Poses of a long box moved so far along its length, in diameters, all good but for the features that are
    ``changed``."""
    count = len(shifts)
    moved = torch.tensor([[shift, 0.0, 0.0] for shift in shifts]).double()
    T = Sim3(torch.ones(count).double(), torch.eye(3).double().expand(count, 3, 3), moved)
    features = {name: torch.full((count,), value).double() for name, value in GOOD.items()}
    features |= {name: torch.tensor(values).double() for name, values in changed.items()}
    problem: Any = SimpleNamespace(model=model_object(boxes([LONG])), view=SimpleNamespace(observation=observation))
    return choose(problem, PoseCandidates.start(T), features, torch.tensor(scores), 0.05)


def test_poses_that_place_nearly_the_same_do_not_compete_in_their_answer() -> None:
    found = answer([0.0, 0.12, 0.6], [0.2, 0.21, 0.5])
    single = answer([0.0, 0.6], [0.2, 0.5])
    assert (found.winner, found.rivals) == (0, [1])
    # Alone it leads by 0.01 in the score; with the other in one answer by more than is told apart.
    term = next(one for one in pose_odds(True).among.terms if one.feature == LEAD)
    lost = term(np.array([VERDICT.most_lead])) - term(np.array([0.01 * VERDICT.log_odds_per_score]))
    assert lost[0] > 0.5
    assert float(found.probability[0].logit() - found.probability_alone[0].logit()) == pytest.approx(lost[0], abs=1e-4)
    assert float(found.probability[0]) == pytest.approx(float(single.probability_alone[0])), "as if it were alone"
    assert float(found.probability[2]) == pytest.approx(float(found.probability_alone[2])), "it is not listed"


@pytest.mark.parametrize(
    ("shifts", "scores", "rivals"), [([0.0, 0.6], [0.2, 0.21], [1]), ([0.0, 0.03, 0.6], [0.2, 0.21, 0.5], [])]
)
def test_poses_that_place_other_surface_compete_though_both_are_listed(
    shifts: list[float], scores: list[float], rivals: list[int]
) -> None:
    found = answer(shifts, scores)
    assert (found.winner, found.rivals) == (0, rivals)
    assert torch.equal(found.probability, found.probability_alone)


def test_what_fits_by_its_score_and_is_much_less_likely_is_no_rival() -> None:
    against = {"seen_through": [0.0, 0.9], "free": [0.0, 0.5], "object_agrees": [1.0, 0.2], "confirmed": [1.0, 0.1]}
    found = answer([0.0, 0.5], [0.2, 0.2], **against, scene_agrees=[1.0, 0.2])
    assert (found.winner, found.rivals) == (0, [])


@pytest.mark.parametrize("observation", [OBSERVED, None])
def test_what_is_known_of_the_scene_decides_on_the_model(observation: object | None) -> None:
    found = answer([0.0, 0.6], [0.2, 0.5], observation, noise=[0.01, 0.01])
    features = {name: torch.full((2,), value).double() for name, value in (GOOD | {"noise": 0.01}).items()}
    scores, apart = torch.tensor([0.2, 0.5]).double(), ~torch.eye(2, dtype=torch.bool)
    said, other = (pose_odds(known).log_odds(features, scores, apart).sigmoid()[0] for known in (True, False))
    assert said != other
    assert float(found.probability[0]) == pytest.approx(float(said if observation else other), abs=1e-9)


# Where the surfaces disagree most, and by how much another shape would fit better.


@pytest.mark.parametrize("growth", [1.0, 1.06])
def test_a_longer_object_is_a_stretch(growth: float) -> None:
    """A box in a room of its own, against a box that is longer along x."""
    half = torch.tensor([0.3, 0.2, 0.25])
    there = boxes([((-half).tolist(), half.tolist())])
    longer = half * torch.tensor([growth, 1.0, 1.0])
    obj = boxes([((-longer).tolist(), longer.tolist())])
    box = OrientedBox(torch.zeros(3).double(), 2.0 * half.double(), torch.eye(3).double())
    problem = make_problem(view_scene(there, box, OPTIONS), model_object(obj, OPTIONS), there, obj, OPTIONS)
    found = features_at(problem, problem.in_working_frames(Sim3.identity()))
    assert found["stretch"] == pytest.approx(growth - 1.0, abs=0.006)


def test_the_worst_place_by_hand() -> None:
    """Two poses, ten samples, each with its two neighbors: of the first pose, one place disagrees wholly."""
    neighbors = torch.arange(10)[:, None] + torch.tensor([0, 1, 2])
    neighbors = neighbors.clamp_max(9)
    values = torch.zeros(2, 10)
    values[0, 3:6] = 1.0
    values[1, ::2] = 0.5
    counts = torch.ones(2, 10, dtype=torch.bool)
    worst = worst_place(values, counts, neighbors, least=3, quantile=1.0)
    torch.testing.assert_close(worst, torch.tensor([1.0, 1.0 / 3.0]))
    counts[0, 4] = False  # what was not seen does not count, nor do places with too little else
    torch.testing.assert_close(
        worst_place(values, counts, neighbors, least=3, quantile=1.0)[0], torch.tensor(1.0 / 3.0)
    )
    torch.testing.assert_close(worst_place(values, counts, neighbors, least=2, quantile=1.0)[0], torch.tensor(1.0))


def test_a_part_more_disagrees_in_its_place(problem: RegistrationProblem) -> None:
    right = features_at(problem, truth(problem))
    for name in ("worst_of_object", "worst_of_scene", "worst_normals"):
        assert right[name] < 0.3, name
    scene, obj = room(chair_pose()), union([chair(), boxes([([-0.25, -0.25, 0.35], [-0.05, -0.05, 0.45])])])
    other = make_problem(problem.view, model_object(obj, OPTIONS), scene, obj, OPTIONS)
    wrong = features_at(other, other.in_working_frames(chair_pose()))
    assert wrong["worst_of_object"] > 0.8
    assert wrong["object_agrees"] > 0.85, "the share of all samples hardly tells it"
