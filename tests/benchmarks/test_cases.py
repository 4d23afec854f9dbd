"""Cases in other frames, and the judgment on results: against what is known of the untouched ones."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import torch

from benchmarks.robust.cases import Case
from benchmarks.robust.judging import AMONG, NOT_AMONG, REJECTED, RIGHT, WRONG, judge
from benchmarks.robust.orientations import random_turn
from benchmarks.robust.symmetries import declared, turn
from regnf_core import RegistrationResult, Sim3
from tests.core.analytic import chair, chair_box, chair_pose, room


def chair_case() -> Case:
    return Case("chair", room(chair_pose()), chair(), chair_box(chair_pose()), chair_pose())


def some_pose(seed: int) -> Sim3:
    generator = torch.Generator().manual_seed(seed)
    shift = torch.randn(3, generator=generator, dtype=torch.float64)
    return replace(random_turn(generator), scale=torch.tensor(0.3 + seed).double(), translation=shift)


def test_a_case_seen_in_other_frames_is_the_same_case() -> None:
    case, T_scene, T_object = chair_case(), some_pose(1), some_pose(2)
    seen = case.seen_in(T_scene, T_object)
    assert case.truth is not None
    assert seen.truth is not None
    points = case.detection.center + (torch.rand(200, 3, dtype=torch.float64) - 0.5) * 2.0 * case.detection.size
    moved = T_scene.apply(points)
    assert torch.equal(seen.detection.contains(moved), case.detection.contains(points))
    assert torch.allclose(
        seen.scene.signed_distance(moved.float()),
        case.scene.signed_distance(points.float()) * T_scene.scale.float(),
        atol=1e-4,
    )
    assert torch.allclose(
        seen.obj.signed_distance(seen.truth.apply(moved).float()),
        case.obj.signed_distance(case.truth.apply(points).float()) * T_object.scale.float(),
        atol=1e-4,
    )


def result(verdict: str, T: Sim3, *others: Sim3) -> RegistrationResult:
    """As much of a result as the judgment looks at."""
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    found = SimpleNamespace(
        verdict=verdict,
        verdict_reason="SURFACES_AGREE",
        T_object_scene=T,
        alternatives=[SimpleNamespace(T_object_scene=other) for other in others],
        object_samples=SimpleNamespace(points=points),
        metrics={"score": 0.1},
    )
    return cast(RegistrationResult, found)


def test_every_verdict_falls_into_its_category() -> None:
    truth = some_pose(1)
    twin = turn((0.0, 0.0, 1.0), 90.0) @ truth
    wrong = turn((1.0, 0.0, 0.0), 40.0) @ truth
    one, four = declared("fc"), declared("et")
    assert judge(result("registered", truth), truth, one)["category"] == RIGHT
    assert judge(result("registered", twin), truth, one)["category"] == WRONG
    assert judge(result("registered", twin), truth, four)["category"] == RIGHT
    assert judge(result("ambiguous", twin, truth), truth, one)["category"] == AMONG
    assert judge(result("ambiguous", twin, wrong), truth, one)["category"] == NOT_AMONG
    assert judge(result("rejected", truth), truth, one)["category"] == REJECTED
    assert judge(result("registered", truth), None, one)["category"] == WRONG
    assert judge(result("ambiguous", truth), None, one)["category"] == NOT_AMONG
