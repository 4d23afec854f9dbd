"""The verdict: how probable a pose has to be, and what else is asked of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
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
from regnf_core.options import RegistrationOptions, RobustOptions
from regnf_core.robust.residuals import SurfacePair, residuals
from regnf_core.robust.verdict.evaluation import PoseVerdict, evaluate_pose
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


def told(evidence: Evidence, hidden: float = 0.0, unexplained: float = 0.0, admitted: bool = True) -> HeldOut:
    features = {"hidden": torch.tensor([hidden]).double(), "unexplained": torch.tensor([unexplained]).double()}
    return HeldOut(evidence, features, torch.tensor([admitted]))


def verdict_on(
    evidence: Evidence = ALIKE,
    probability: float = 0.99,
    hidden: float = 0.0,
    unexplained: float = 0.0,
    rivals: int = 0,
    **options: Any,
) -> PoseVerdict:
    return evaluate_pose(told(evidence, hidden, unexplained), 0, rivals, RobustOptions(**options), probability)


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


@pytest.mark.parametrize(
    ("probability", "below", "rivals", "verdict", "reason"),
    [
        *((enough, enough, 0, "registered", "SURFACES_AGREE") for enough in (0.5, 0.9, 0.95)),
        *((enough, enough, 1, "ambiguous", "SEVERAL_POSES_AGREE") for enough in (0.5, 0.9, 0.95)),
        *((enough - 0.01, enough, 0, "rejected", "FREE_SPACE_VIOLATED") for enough in (0.5, 0.9, 0.95)),
        (1.0, 1.0, 0, "rejected", "FREE_SPACE_VIOLATED"),  # always
        (0.7, 0.0, 0, "registered", "SURFACES_AGREE"),  # never
    ],
)
def test_from_the_probability_of_the_options_on_shares_do_not_count(
    probability: float, below: float, rivals: int, verdict: str, reason: str
) -> None:
    found = verdict_on(FREE, probability, rivals=rivals, share_limits_below=below, min_probability=0.2)
    assert (found.verdict, found.reason) == (verdict, reason)


@given(
    probability=st.floats(0.0, 1.0),
    least=st.floats(0.0, 1.0),
    below=st.floats(0.0, 1.0),
    shares=st.floats(0.01, 1.0),
    rivals=st.integers(0, 3),
)
def test_no_answer_below_the_minimum_is_accepted(
    probability: float, least: float, below: float, shares: float, rivals: int
) -> None:
    options: dict[str, Any] = {
        "min_probability": least,
        "share_limits_below": below,
        "min_inlier_share": shares,
        "max_free_space_violations": shares,
    }
    found = verdict_on(FREE, probability, rivals=rivals, **options)
    assert found.verdict == "rejected" or probability >= least
    sound = verdict_on(ALIKE, probability, rivals=rivals, **options)
    assert (sound.verdict == "rejected") == (probability < least)
    if probability < least:
        assert sound.reason == "LOW_PROBABILITY"


@pytest.mark.parametrize(
    ("probability", "least", "said"),
    [
        (0.6411, 0.7, "probability 0.641, at least 0.7 is needed"),
        (0.69996, 0.7, "probability 0.69996, at least 0.7 is needed"),  # and not "0.7, at least 0.7"
    ],
)
def test_a_rejection_says_the_number_and_its_limit(probability: float, least: float, said: str) -> None:
    assert verdict_on(probability=probability, min_probability=least).broken == said
    assert verdict_on().broken == ""


def test_a_pose_outside_of_the_detection_is_rejected_first() -> None:
    found = evaluate_pose(told(FREE, admitted=False), 0, 0, RobustOptions(), 0.2)
    assert (found.verdict, found.reason, found.margin) == ("rejected", "OUTSIDE_DETECTION", -1.0)


def test_by_default_a_pose_below_nine_tenths_has_to_keep_the_share_limits() -> None:
    assert verdict_on(probability=0.7).verdict == "registered"
    assert verdict_on(probability=0.7).margin == 0.0
    less = verdict_on(probability=0.69)
    assert (less.verdict, less.reason, round(less.margin, 6)) == ("rejected", "LOW_PROBABILITY", -0.01)
    assert verdict_on(FREE, probability=0.69).reason == "FREE_SPACE_VIOLATED"
    assert verdict_on(FREE, probability=0.89).reason == "FREE_SPACE_VIOLATED"
    assert verdict_on(FREE, probability=0.9).verdict == "registered"


@pytest.mark.parametrize(("hidden", "verdict"), [(0.94, "registered"), (0.96, "rejected"), (float("nan"), "rejected")])
def test_where_nearly_nothing_was_observed_no_probability_helps(hidden: float, verdict: str) -> None:
    judged = verdict_on(hidden=hidden)
    assert judged.verdict == verdict
    assert (judged.reason == "TOO_LITTLE_SURFACE") is (verdict == "rejected")


def test_the_share_that_may_be_occluded_is_an_option() -> None:
    nine_occluded = evidence_of([0.0] * 10, [0.0] + [-0.2] * 9)
    assert verdict_on(nine_occluded).reason == "TOO_LITTLE_SURFACE"
    assert verdict_on(nine_occluded, max_occluded_share=0.9).verdict == "registered"


def test_surface_of_a_similar_object_is_allowed_by_the_noise_where_it_was_seen() -> None:
    found = evidence_of([0.002] * 10, [0.002] * 10)
    assert verdict_on(found, unexplained=0.3).verdict == "registered"  # a field may have invented it
    seen = replace(found, partial=True)
    assert verdict_on(seen, unexplained=0.089).verdict == "registered"  # 0.05 + 20 * 0.002
    outcome = verdict_on(seen, unexplained=0.1)
    assert (outcome.verdict, outcome.reason) == ("rejected", "SURFACE_UNEXPLAINED")
    assert outcome.margin == pytest.approx(0.05 + 20 * 0.002 - 0.1, abs=1e-6)
    # A field of one depth image: what is mostly hidden says itself what was seen.
    assert verdict_on(found, unexplained=0.1, hidden=0.6).reason == "SURFACE_UNEXPLAINED"
    assert verdict_on(found, unexplained=0.1, hidden=0.4).verdict == "registered"


@pytest.mark.parametrize(
    ("option", "limit", "kept", "margin", "reason", "evidence"),
    [
        ("max_free_space_violations", 0.29, 0.31, -0.01, "FREE_SPACE_VIOLATED", FREE),
        # Four tenths of what stands there are another shape; of the object, three in twenty do not agree.
        ("min_inlier_share", 0.61, 0.59, -0.01, "LOW_OVERLAP", evidence_of([0.0] * 6 + [0.06] * 4, [0.0] * 10)),
        ("min_inlier_share", 0.86, 0.84, -0.01, "LOW_OVERLAP", evidence_of([0.0] * 10, [0.0] * 17 + [0.02] * 3)),
        # Most of what stands in the box is something else.
        (
            "min_explained_share",
            0.34,
            0.33,
            5 / 15 - 0.34,
            "SCENE_UNEXPLAINED",
            evidence_of([0.0] * 5 + [0.5] * 10, [0.0] * 10),
        ),
    ],
)
def test_the_limits_are_options(
    option: str, limit: float, kept: float, margin: float, reason: str, evidence: Evidence
) -> None:
    within, beyond = (RegistrationOptions.from_dict({"robust": {option: value}}).robust for value in (kept, limit))
    assert evaluate_pose(told(evidence), 0, 0, within, 0.8).verdict == "registered"
    outcome = evaluate_pose(told(evidence), 0, 0, beyond, 0.8)
    assert (outcome.verdict, outcome.reason) == ("rejected", reason)
    assert outcome.margin == pytest.approx(margin, abs=1e-6)


@given(
    scene_to_object=st.lists(st.floats(-0.2, 0.2), min_size=4, max_size=12),
    object_to_scene=st.lists(st.floats(-0.2, 0.2), min_size=4, max_size=12),
    probability=st.floats(0.0, 1.0),
    hidden=st.floats(0.0, 1.0),
    limit=st.floats(0.01, 1.0),
)
def test_the_margin_is_negative_for_rejections_alone(
    scene_to_object: list[float], object_to_scene: list[float], probability: float, hidden: float, limit: float
) -> None:
    limits = ("min_inlier_share", "min_explained_share", "max_free_space_violations")
    options: dict[str, Any] = dict.fromkeys(limits, limit)
    outcome = verdict_on(evidence_of(scene_to_object, object_to_scene), probability, hidden, **options)
    assert (outcome.margin < 0.0) == (outcome.verdict == "rejected")
    assert -1.0 <= outcome.margin <= 1.0


def test_numbers_that_are_none_are_rejected() -> None:
    nothing = float("nan")
    assert verdict_on(probability=nothing).verdict == "rejected"
    assert verdict_on(evidence_of([nothing] * 5, [nothing] * 5), probability=0.8).verdict == "rejected"


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
