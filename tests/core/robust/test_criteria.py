"""The verdict: how probable a pose has to be, and what else is asked of it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from regnf_core import RegistrationResult, register, register_batch
from regnf_core.document import result_document
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import LibraryObject, model_object, search_library
from regnf_core.options import Acceptance, RegistrationOptions, RobustOptions
from regnf_core.robust.residuals import SurfacePair, residuals
from regnf_core.robust.verdict.evaluation import LEVELS, PoseVerdict, evaluate_pose, level_of
from regnf_core.robust.verdict.evidence import Evidence, HeldOut, gather_evidence
from regnf_core.robust.working_frame import Samples
from tests.core.analytic import chair, chair_pose, room, table
from tests.core.robust.shapes import detection, run, slab_table, table_room
from tests.golden.cases import SLAB_BOX

D = torch.float64
UP = torch.tensor([0.0, 0.0, 1.0])


class Flat:
    """A plane that lies at height 0, whose field claims at each point what is listed for it, by its x."""

    def __init__(self, heights: Tensor) -> None:
        self.heights = heights

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return self.heights[points[:, 0].round().long()], UP.expand_as(points)


def evidence_of(scene_to_object: list[float], object_to_scene: list[float]) -> Evidence:
    """The evidence of these residuals of the scene's samples and of the object's samples."""

    def samples(count: int) -> Samples:
        points = torch.zeros(count, 3)
        points[:, 0] = torch.arange(count)
        return Samples(points, torch.zeros(count), UP.expand(count, 3))

    identity = Sim3(torch.ones(1, dtype=D), torch.eye(3, dtype=D)[None], torch.zeros(1, 3, dtype=D))
    scene, obj = Flat(torch.tensor(object_to_scene)), Flat(torch.tensor(scene_to_object))
    offset = torch.zeros(1, dtype=D)
    surfaces = SurfacePair(scene, obj, samples(len(scene_to_object)), samples(len(object_to_scene)))
    return gather_evidence(residuals(surfaces, identity, offset), offset, RobustOptions())


ALIKE = evidence_of([0.0] * 10, [0.0] * 10)


def told(evidence: Evidence, unexplained: float = 0.0, admitted: bool = True) -> HeldOut:
    hidden = 0.95 if evidence is HIDDEN else 0.0
    features = {"unexplained": torch.tensor([unexplained]).double(), "hidden": torch.tensor([hidden]).double()}
    return HeldOut(evidence, features, torch.tensor([admitted]))


def verdict_on(
    evidence: Evidence = ALIKE,
    probability: float = 0.99,
    unexplained: float = 0.0,
    rivals: int = 0,
    **options: Any,
) -> PoseVerdict:
    return evaluate_pose(told(evidence, unexplained), 0, rivals, RobustOptions(**options), probability)


@pytest.mark.parametrize(
    ("scene_to_object", "object_to_scene", "expected"),
    [
        # Scene: 8 of 10 near ones within 0.03, one too far to count. Object: 9 of 10 within, one in free space.
        ([0.02] * 8 + [0.05] * 2 + [0.4], [0.025] * 9 + [0.06], 0.8 - 0.1),
        # 2 of 10 within matter: no agreement, but none of the 8 others lies in free space.
        ([0.0] * 10, [0.0] * 8 + [-0.2] * 2, 0.8),
    ],
)
def test_coarse_agreement_by_hand(scene_to_object: list[float], object_to_scene: list[float], expected: float) -> None:
    found = evidence_of(scene_to_object, object_to_scene).numbers["coarse_agreement"]
    assert float(found[0]) == pytest.approx(expected)


FREE = evidence_of([0.0] * 10, [0.0] * 7 + [0.1] * 3)
"""Three tenths of the object are where the scene is free."""
HIDDEN = evidence_of([0.0] * 10, [0.0] + [-0.2] * 9)
HALF = evidence_of([0.0] * 5 + [0.06] * 5, [0.0] * 10)
"""Half of what stands there is another shape."""
AMONG = evidence_of([0.0] * 5 + [0.5] * 10, [0.0] * 10)
"""Most of what stands in the box is something else."""


@given(probability=st.floats(0.0, 1.0), least=st.floats(0.0, 1.0), rivals=st.integers(0, 3), alike=st.booleans())
def test_the_probability_alone_decides(probability: float, least: float, rivals: int, alike: bool) -> None:
    found = verdict_on(ALIKE if alike else FREE, probability, rivals=rivals, min_probability=least)
    accepted = ("ambiguous", "SEVERAL_POSES_AGREE") if rivals else ("registered", "SURFACES_AGREE")
    if probability >= least:
        assert (found.verdict, found.reason) == accepted
    else:
        assert (found.verdict, found.reason) == ("rejected", "LOW_PROBABILITY" if alike else "FREE_SPACE_VIOLATED")
    assert found.margin == pytest.approx(probability - least)
    assert (found.margin < 0.0) == (found.verdict == "rejected")


@pytest.mark.parametrize("name", ["default", "strict"])
def test_a_level_is_a_least_probability_with_a_name(name: Acceptance) -> None:
    least = LEVELS[name]
    assert verdict_on(probability=least, acceptance=name).verdict == "registered"
    assert verdict_on(probability=least - 1e-9, acceptance=name).verdict == "rejected"
    assert verdict_on(probability=0.3, acceptance=name, min_probability=0.3).verdict == "registered"


def test_the_level_of_a_probability_is_the_strictest_that_it_reaches() -> None:
    assert 0.5 < LEVELS["default"] < LEVELS["strict"] < 1.0
    assert level_of(LEVELS["default"] - 1e-9) is None
    assert level_of(LEVELS["default"]) == level_of(LEVELS["strict"] - 1e-9) == "default"
    assert level_of(LEVELS["strict"]) == level_of(1.0) == "strict"


@pytest.mark.parametrize(
    ("probability", "least", "said"),
    [
        (0.6411, 0.7, "probability 0.641, at least 0.7 is required"),
        (0.69996, 0.7, "probability 0.69996, at least 0.7 is required"),  # and not "0.7, at least 0.7"
    ],
)
def test_a_rejection_says_the_number_and_its_limit(probability: float, least: float, said: str) -> None:
    assert verdict_on(probability=probability, min_probability=least).broken == said
    assert verdict_on().broken == ""


def test_a_pose_outside_of_the_detection_is_rejected_first() -> None:
    found = evaluate_pose(told(FREE, admitted=False), 0, 0, RobustOptions(), 1.0)
    assert (found.verdict, found.reason, found.margin) == ("rejected", "OUTSIDE_DETECTION", -1.0)


@pytest.mark.parametrize(
    ("evidence", "unexplained", "reason", "said"),
    [
        (HIDDEN, 0.0, "TOO_LITTLE_SURFACE", "hidden share 0.95, usually 0.9 or less"),
        (FREE, 0.0, "FREE_SPACE_VIOLATED", "share in free space 0.3, usually 0.2 or less"),
        (HALF, 0.0, "LOW_OVERLAP", "scene inliers 0.5, usually 0.6 or more"),
        (ALIKE, 0.3, "SURFACE_UNEXPLAINED", "unexplained share 0.3, usually 0.1 or less"),
        (AMONG, 0.0, "SCENE_UNEXPLAINED", "explained share 0.333, usually 0.4 or more"),
        (ALIKE, 0.0, "LOW_PROBABILITY", ""),
    ],
)  # fmt: skip
def test_the_shares_say_why_a_pose_is_rejected_and_decide_nothing(
    evidence: Evidence, unexplained: float, reason: str, said: str
) -> None:
    rejected = verdict_on(evidence, 0.5, unexplained)
    assert (rejected.verdict, rejected.reason) == ("rejected", reason)
    assert rejected.broken.removeprefix("probability 0.5, at least 0.8 is required").removeprefix("; ") == said
    assert verdict_on(evidence, 1.0, unexplained).verdict == "registered"


def test_numbers_that_are_none_are_rejected() -> None:
    nothing = float("nan")
    assert verdict_on(probability=nothing).verdict == "rejected"
    assert verdict_on(evidence_of([nothing] * 5, [nothing] * 5), probability=0.7).verdict == "rejected"


# The option ``min_probability`` on every way to an answer: none below it is accepted, and those from it on are.


NEAR = Sim3.from_quaternion(1.02, [0.02, -0.03, 0.04, 1.0], [0.02, -0.01, 0.02]) @ chair_pose()
Way = Callable[[RegistrationOptions], RegistrationResult | None]


def searched(options: RegistrationOptions) -> RegistrationResult:
    shapes = {"table": table(), "chair": chair()}
    library = [LibraryObject(name, partial(shapes.__getitem__, name), model_object(shapes[name])) for name in shapes]
    found = search_library(room(chair_pose()), detection(), library, options)
    first = found.ranking[0]
    assert (first.name, first.verdict, first.probability) == ("chair", found.result.verdict, found.result.probability)
    assert all(one.verdict == "rejected" for one in found.ranking[1:] if one.verdict)
    return found.result


WAYS: dict[str, Way] = {
    "register": lambda options: run(room(chair_pose()), chair(), detection(), options),
    "from a start": lambda options: register(
        room(chair_pose()), chair(), detection(), options, initial_transform=NEAR, clouds=False
    ),
    "ambiguous": lambda options: run(table_room(chair_pose(1.4)), slab_table(), SLAB_BOX, options),
    "batch": lambda options: register_batch(room(chair_pose()), [detection()], [chair()], options=options)[0].result,
    "search": searched,
}


@pytest.mark.parametrize("way", WAYS)
def test_above_its_probability_no_answer_is_accepted(way: str) -> None:
    found = WAYS[way](RegistrationOptions.from_dict({"robust": {"min_probability": 1.0, "feature_draws": 0}}))
    assert found is not None
    assert found.probability is not None
    assert 0.9 <= found.probability < 1.0, "a right answer, which the default accepts"
    assert (found.verdict, found.verdict_reason) == ("rejected", "LOW_PROBABILITY")
    document = result_document(found)
    assert document["probability"] == document["metrics"]["probability"] == found.probability
    assert "at least" in document["verdict_detail"]
    assert document["considered"][0]["metrics"]["probability"] == found.probability
