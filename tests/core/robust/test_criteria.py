"""The verdict: how probable a pose has to be, what else is asked of it, and what speaks most against it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RobustOptions
from regnf_core.robust.residuals import SurfacePair
from regnf_core.robust.samples import Samples
from regnf_core.robust.verdict.criteria import PoseVerdict, evaluate_pose
from regnf_core.robust.verdict.evidence import Evidence, gather_evidence

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
    return gather_evidence(surfaces, identity, offset, RobustOptions())


ALIKE = evidence_of([0.0] * 10, [0.0] * 10)


def verdict_on(
    evidence: Evidence = ALIKE,
    probability: float = 0.99,
    hidden: float = 0.0,
    unexplained: float = 0.0,
    rivals: int = 0,
    **options: Any,
) -> PoseVerdict:
    features = {"hidden": hidden, "unexplained": unexplained}
    return evaluate_pose(evidence, 0, rivals, RobustOptions(**options), features, probability)


def test_coarse_agreement_by_hand() -> None:
    # Scene: 8 of 10 near ones within 0.03, one too far to count. Object: 9 of 10 within, one of all 10 in free space.
    found = evidence_of([0.02] * 8 + [0.05] * 2 + [0.4], [0.025] * 9 + [0.06])
    assert float(found.coarse[0]) == pytest.approx(0.8 - 0.1)


def test_matter_around_the_object_is_no_free_space() -> None:
    # 2 of 10 within matter: no agreement, but none of the 8 others lies in free space.
    assert float(evidence_of([0.0] * 10, [0.0] * 8 + [-0.2] * 2).coarse[0]) == pytest.approx(0.8)


@pytest.mark.parametrize("least", [0.5, 0.8, 1.0])
def test_the_probability_decides(least: float) -> None:
    enough = verdict_on(probability=least, min_probability=least)
    assert (enough.verdict, enough.reason, enough.margin) == ("registered", "SURFACES_AGREE", 0.0)
    several = verdict_on(probability=least, min_probability=least, rivals=1)
    assert (several.verdict, several.reason) == ("ambiguous", "SEVERAL_POSES_AGREE")
    less = verdict_on(probability=least - 0.01, min_probability=least)
    assert (less.verdict, less.reason) == ("rejected", "LOW_PROBABILITY")
    assert less.margin == pytest.approx(-0.01)


@pytest.mark.parametrize(("hidden", "verdict"), [(0.94, "registered"), (0.96, "rejected"), (float("nan"), "rejected")])
def test_where_nearly_nothing_was_observed_no_probability_helps(hidden: float, verdict: str) -> None:
    """All samples agree, at places that nobody saw."""
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
        # Three tenths of the object where the scene is free.
        (
            "max_free_space_violations",
            0.29,
            0.31,
            -0.01,
            "FREE_SPACE_VIOLATED",
            evidence_of([0.0] * 10, [0.0] * 7 + [0.1] * 3),
        ),
        # Four tenths of what stands there are another shape; of the object, two tenths do not agree.
        ("min_inlier_share", 0.61, 0.59, -0.01, "LOW_OVERLAP", evidence_of([0.0] * 6 + [0.06] * 4, [0.0] * 10)),
        ("min_inlier_share", 0.81, 0.79, -0.01, "LOW_OVERLAP", evidence_of([0.0] * 10, [0.0] * 8 + [0.02] * 2)),
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
def test_limits_of_the_options_hold_however_probable_the_pose_is(
    option: str, limit: float, kept: float, margin: float, reason: str, evidence: Evidence
) -> None:
    assert verdict_on(evidence).verdict == "registered"
    assert verdict_on(evidence, **{option: kept}).verdict == "registered"
    outcome = verdict_on(evidence, **{option: limit})
    assert (outcome.verdict, outcome.reason) == ("rejected", reason)
    assert outcome.margin == pytest.approx(margin, abs=1e-6)


@pytest.mark.parametrize(
    ("evidence", "unexplained", "reason"),
    [
        (evidence_of([0.0] * 10, [0.0] * 8 + [0.1] * 2), 0.0, "FREE_SPACE_VIOLATED"),
        (evidence_of([0.0] * 20, [0.0] * 19 + [0.1]), 0.0, "LOW_PROBABILITY"),  # a twentieth is not enough
        (evidence_of([0.0] * 5 + [0.06] * 5, [0.0] * 10), 0.0, "LOW_OVERLAP"),
        (evidence_of([0.0] * 10, [0.0] * 5 + [-0.01] * 5), 0.0, "LOW_PROBABILITY"),  # within the inlier distance
        (evidence_of([0.0] * 5 + [0.5] * 10, [0.0] * 10), 0.0, "SCENE_UNEXPLAINED"),
        (ALIKE, 0.06, "SURFACE_UNEXPLAINED"),
        (ALIKE, 0.04, "LOW_PROBABILITY"),
    ],
)
def test_an_improbable_pose_is_told_to_have_the_first_fault_that_shows(
    evidence: Evidence, unexplained: float, reason: str
) -> None:
    assert verdict_on(evidence, probability=0.79, unexplained=unexplained).reason == reason
    assert verdict_on(evidence, probability=0.81, unexplained=unexplained).verdict == "registered"


@given(
    scene_to_object=st.lists(st.floats(-0.2, 0.2), min_size=4, max_size=12),
    object_to_scene=st.lists(st.floats(-0.2, 0.2), min_size=4, max_size=12),
    probability=st.floats(0.0, 1.0),
    hidden=st.floats(0.0, 1.0),
    limit=st.none() | st.floats(0.01, 1.0),
)
def test_the_margin_is_negative_for_rejections_alone(
    scene_to_object: list[float], object_to_scene: list[float], probability: float, hidden: float, limit: float | None
) -> None:
    options = dict.fromkeys(("min_inlier_share", "min_explained_share", "max_free_space_violations"), limit)
    outcome = verdict_on(evidence_of(scene_to_object, object_to_scene), probability, hidden, **options)
    assert (outcome.margin < 0.0) == (outcome.verdict == "rejected")
    assert -1.0 <= outcome.margin <= 1.0


def test_numbers_that_are_none_are_rejected() -> None:
    nothing = float("nan")
    assert verdict_on(probability=nothing).verdict == "rejected"
    assert verdict_on(evidence_of([nothing] * 5, [nothing] * 5), min_inlier_share=0.1).verdict == "rejected"
