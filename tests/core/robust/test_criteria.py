"""The verdict from given residuals: what rough fields are forgiven, and what they are not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RobustOptions
from regnf_core.robust.residuals import SurfacePair
from regnf_core.robust.samples import Samples
from regnf_core.robust.verdict.criteria import PoseVerdict, SceneQuality, evaluate_pose
from regnf_core.robust.verdict.evidence import Evidence, gather_evidence

D = torch.float64
ROUGH = 0.06
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


def verdict_on(
    evidence: Evidence, rivals: int = 0, normal_roughness: float = 0.0, unexplained: float = 0.0
) -> PoseVerdict:
    return evaluate_pose(evidence, 0, rivals, RobustOptions(), SceneQuality(normal_roughness, unexplained))


def test_coarse_agreement_by_hand() -> None:
    # Scene: 8 of 10 near ones within 0.03, one too far to count. Object: 9 of 10 within, one of all 10 in free space.
    found = evidence_of([0.02] * 8 + [0.05] * 2 + [0.4], [0.025] * 9 + [0.06])
    assert float(found.coarse[0]) == pytest.approx(0.8 - 0.1)
    assert float(found.explained_coarsely[0]) == pytest.approx(8 / 11)


def test_matter_around_the_object_is_no_free_space() -> None:
    # 2 of 10 within matter: no agreement, but none of the 8 others lies in free space.
    assert float(evidence_of([0.0] * 10, [0.0] * 8 + [-0.2] * 2).coarse[0]) == pytest.approx(0.8)


@pytest.mark.parametrize(("hidden", "verdict"), [(0.94, "registered"), (0.96, "rejected"), (float("nan"), "rejected")])
def test_where_nearly_nothing_was_observed_no_probability_helps(hidden: float, verdict: str) -> None:
    """All samples agree, at places that nobody saw."""
    found = evidence_of([0.0] * 10, [0.0] * 10)
    judged = evaluate_pose(found, 0, 0, RobustOptions(), SceneQuality(hidden=hidden), 0.99)
    assert judged.verdict == verdict
    assert (judged.reason == "TOO_LITTLE_SURFACE") is (verdict == "rejected")


def test_roughness_is_forgiven_on_rough_fields_alone() -> None:
    found = evidence_of([0.005] * 4 + [0.02] * 5 + [-0.02] * 1, [0.005] * 4 + [0.02] * 3 + [-0.02] * 3)
    assert verdict_on(found).verdict == "rejected"
    forgiven = verdict_on(found, normal_roughness=ROUGH)
    assert (forgiven.verdict, forgiven.reason) == ("registered", "SURFACES_AGREE")
    assert verdict_on(found, 1, normal_roughness=ROUGH).verdict == "ambiguous"


@pytest.mark.parametrize(
    ("scene_to_object", "object_to_scene"),
    [
        ([0.0] * 10, [0.0] * 7 + [0.1] * 3),  # three tenths of the object where the scene is free
        ([0.0] * 6 + [0.06] * 4, [0.0] * 10),  # four tenths of what stands there is another shape
        ([0.0] * 5 + [0.5] * 10, [0.0] * 10),  # most of what stands in the box is something else
        ([0.0] * 10, [0.0] * 1 + [-0.2] * 9),  # next to nothing of the object was seen
    ],
)
def test_another_shape_is_not_forgiven(scene_to_object: list[float], object_to_scene: list[float]) -> None:
    assert verdict_on(evidence_of(scene_to_object, object_to_scene), normal_roughness=ROUGH).verdict == "rejected"


def test_the_score_may_be_as_bad_as_the_normals_explain() -> None:
    found = evidence_of([0.005] * 4 + [0.02] * 5 + [-0.02] * 1, [0.005] * 4 + [0.02] * 3 + [-0.02] * 3)
    # Four tenths lose 1 - 0.015^2 / (0.015^2 + 0.005^2) = 0.1, six tenths 1 - 0.015^2 / (0.015^2 + 0.02^2) = 0.64.
    assert float(found.scores[0]) == pytest.approx(0.4 * 0.1 + 0.6 * 0.64)
    assert verdict_on(found, normal_roughness=0.021).verdict == "rejected"
    assert verdict_on(found, normal_roughness=0.023).verdict == "registered"


def test_errors_in_one_place_alone_are_another_shape() -> None:
    alike = evidence_of([0.004] * 5 + [0.02] * 5, [0.004] * 5 + [0.02] * 4 + [0.02] * 1)
    apart = evidence_of([0.001] * 5 + [0.02] * 5, [0.001] * 5 + [0.02] * 4 + [0.02] * 1)
    assert float(alike.tail_ratio[0]) == pytest.approx(5.0)
    assert float(apart.tail_ratio[0]) == pytest.approx(20.0)
    assert verdict_on(alike, normal_roughness=ROUGH).verdict == "registered"
    assert verdict_on(apart, normal_roughness=ROUGH).verdict == "rejected"


def test_joined_surface_is_allowed_by_the_noise_and_by_what_was_measured() -> None:
    found = evidence_of([0.002] * 10, [0.002] * 10)
    assert verdict_on(found, unexplained=0.069).verdict == "registered"  # 0.03 + 20 * 0.002
    outcome = verdict_on(found, unexplained=0.1)
    assert (outcome.verdict, outcome.reason) == ("rejected", "SURFACE_UNEXPLAINED")
    assert outcome.margin == pytest.approx(0.03 + 20 * 0.002 - 0.1, abs=1e-6)
    seen = replace(found, partial=True)
    assert verdict_on(seen, unexplained=0.089).verdict == "registered"  # 0.05 + 20 * 0.002
    assert verdict_on(seen, unexplained=0.091).verdict == "rejected"


def test_joined_surface_is_not_forgiven_for_roughness() -> None:
    found = evidence_of([0.005] * 4 + [0.02] * 6, [0.005] * 4 + [0.02] * 6)
    assert verdict_on(found, normal_roughness=ROUGH, unexplained=0.1).verdict == "registered"
    outcome = verdict_on(found, normal_roughness=ROUGH, unexplained=0.2)
    assert (outcome.verdict, outcome.reason) == ("rejected", "SURFACE_UNEXPLAINED")


def test_measured_surface_may_agree_at_twice_the_distance_however_smooth() -> None:
    found = evidence_of([0.02] * 10, [0.02] * 10)
    assert verdict_on(found).verdict == "rejected"
    seen = replace(found, partial=True)
    assert verdict_on(seen).verdict == "registered"
    thick = replace(seen, offsets=torch.tensor([0.016]))
    assert verdict_on(thick).verdict == "rejected"
    little = replace(evidence_of([0.02] * 10, [0.02] * 3 + [-0.1] * 7), partial=True)
    assert verdict_on(little).verdict == "rejected"
    assert verdict_on(little, normal_roughness=ROUGH).verdict == "rejected"


@given(
    scene_to_object=st.lists(st.floats(-0.2, 0.2), min_size=4, max_size=12),
    object_to_scene=st.lists(st.floats(-0.2, 0.2), min_size=4, max_size=12),
    normal_roughness=st.floats(0.0, 0.1),
    partial=st.booleans(),
)
def test_the_margin_is_negative_for_rejections_alone(
    scene_to_object: list[float], object_to_scene: list[float], normal_roughness: float, partial: bool
) -> None:
    outcome = verdict_on(replace(evidence_of(scene_to_object, object_to_scene), partial=partial), 0, normal_roughness)
    assert (outcome.margin < 0.0) == (outcome.verdict == "rejected")
    assert outcome.margin <= 1.0


def test_numbers_that_are_none_are_rejected() -> None:
    nothing = float("nan")
    assert verdict_on(evidence_of([nothing] * 5, [nothing] * 5), normal_roughness=ROUGH).verdict == "rejected"
