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
from regnf_core.robust.residuals import Samples
from regnf_core.robust.verdict.evidence import Evidence, gather_evidence
from regnf_core.robust.verdict.judgment import decide

D = torch.float64
ROUGH = 0.06
UP = torch.tensor([0.0, 0.0, 1.0])


class Flat:
    """A plane that lies at height 0, whose field claims at each point what is listed for it, by its x."""

    def __init__(self, heights: Tensor) -> None:
        self.heights = heights

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return self.heights[points[:, 0].round().long()], UP.expand_as(points)


def judged(forth: list[float], back: list[float]) -> Evidence:
    """The evidence where the scene's samples differ by ``forth`` from the object, and the object's by ``back``."""

    def samples(count: int) -> Samples:
        points = torch.zeros(count, 3)
        points[:, 0] = torch.arange(count)
        return Samples(points, torch.zeros(count), UP.expand(count, 3))

    identity = Sim3(torch.ones(1, dtype=D), torch.eye(3, dtype=D)[None], torch.zeros(1, 3, dtype=D))
    scene, obj = Flat(torch.tensor(back)), Flat(torch.tensor(forth))
    offset = torch.zeros(1, dtype=D)
    return gather_evidence(scene, obj, samples(len(forth)), samples(len(back)), identity, RobustOptions(), offset)


def test_coarse_agreement_by_hand() -> None:
    # Scene: 8 of 10 near ones within 0.03, one too far to count. Object: 9 of 10 within, one of all 10 in free space.
    found = judged([0.02] * 8 + [0.05] * 2 + [0.4], [0.025] * 9 + [0.06])
    assert float(found.coarse[0]) == pytest.approx(0.8 - 0.1)
    assert float(found.explained_coarsely[0]) == pytest.approx(8 / 11)


def test_matter_around_the_object_is_no_free_space() -> None:
    # 2 of 10 within matter: no agreement, but none of the 8 others lies in free space.
    assert float(judged([0.0] * 10, [0.0] * 8 + [-0.2] * 2).coarse[0]) == pytest.approx(0.8)


def test_roughness_is_forgiven_on_rough_fields_alone() -> None:
    found = judged([0.005] * 4 + [0.02] * 5 + [-0.02] * 1, [0.005] * 4 + [0.02] * 3 + [-0.02] * 3)
    assert decide(found, 0, 0, RobustOptions()).verdict == "rejected"
    forgiven = decide(found, 0, 0, RobustOptions(), incoherence=ROUGH)
    assert (forgiven.verdict, forgiven.reason) == ("registered", "SURFACES_AGREE")
    assert decide(found, 0, 1, RobustOptions(), incoherence=ROUGH).verdict == "ambiguous"


@pytest.mark.parametrize(
    ("forth", "back"),
    [
        ([0.0] * 10, [0.0] * 7 + [0.1] * 3),  # three tenths of the object where the scene is free
        ([0.0] * 6 + [0.06] * 4, [0.0] * 10),  # four tenths of what stands there is another shape
        ([0.0] * 5 + [0.5] * 10, [0.0] * 10),  # most of what stands in the box is something else
        ([0.0] * 10, [0.0] * 2 + [-0.2] * 8),  # next to nothing of the object was seen
    ],
)
def test_another_shape_is_not_forgiven(forth: list[float], back: list[float]) -> None:
    assert decide(judged(forth, back), 0, 0, RobustOptions(), incoherence=ROUGH).verdict == "rejected"


def test_the_score_may_be_as_bad_as_the_normals_explain() -> None:
    found = judged([0.005] * 4 + [0.02] * 5 + [-0.02] * 1, [0.005] * 4 + [0.02] * 3 + [-0.02] * 3)
    # Four tenths lose 1 - 0.015^2 / (0.015^2 + 0.005^2) = 0.1, six tenths 1 - 0.015^2 / (0.015^2 + 0.02^2) = 0.64.
    assert float(found.scores[0]) == pytest.approx(0.4 * 0.1 + 0.6 * 0.64)
    assert decide(found, 0, 0, RobustOptions(), incoherence=0.021).verdict == "rejected"
    assert decide(found, 0, 0, RobustOptions(), incoherence=0.023).verdict == "registered"


def test_errors_in_one_place_alone_are_another_shape() -> None:
    alike = judged([0.004] * 5 + [0.02] * 5, [0.004] * 5 + [0.02] * 4 + [0.02] * 1)
    apart = judged([0.001] * 5 + [0.02] * 5, [0.001] * 5 + [0.02] * 4 + [0.02] * 1)
    assert float(alike.tail[0]) == pytest.approx(5.0)
    assert float(apart.tail[0]) == pytest.approx(20.0)
    assert decide(alike, 0, 0, RobustOptions(), incoherence=ROUGH).verdict == "registered"
    assert decide(apart, 0, 0, RobustOptions(), incoherence=ROUGH).verdict == "rejected"


def test_joined_surface_is_allowed_by_the_noise_and_by_what_was_measured() -> None:
    found = judged([0.002] * 10, [0.002] * 10)
    assert decide(found, 0, 0, RobustOptions(), extra=0.069).verdict == "registered"  # 0.03 + 20 * 0.002
    decision = decide(found, 0, 0, RobustOptions(), extra=0.1)
    assert (decision.verdict, decision.reason) == ("rejected", "SURFACE_UNEXPLAINED")
    assert decision.margin == pytest.approx(0.03 + 20 * 0.002 - 0.1, abs=1e-6)
    seen = replace(found, partial=True)
    assert decide(seen, 0, 0, RobustOptions(), extra=0.057).verdict == "registered"  # 0.05 + 4 * 0.002
    assert decide(seen, 0, 0, RobustOptions(), extra=0.059).verdict == "rejected"


def test_joined_surface_is_not_forgiven_for_roughness() -> None:
    found = judged([0.005] * 4 + [0.02] * 6, [0.005] * 4 + [0.02] * 6)
    assert decide(found, 0, 0, RobustOptions(), incoherence=ROUGH, extra=0.1).verdict == "registered"
    decision = decide(found, 0, 0, RobustOptions(), incoherence=ROUGH, extra=0.2)
    assert (decision.verdict, decision.reason) == ("rejected", "SURFACE_UNEXPLAINED")


def test_measured_surface_may_agree_at_twice_the_distance_however_smooth() -> None:
    found = judged([0.02] * 10, [0.02] * 10)
    assert decide(found, 0, 0, RobustOptions()).verdict == "rejected"
    seen = replace(found, partial=True)
    assert decide(seen, 0, 0, RobustOptions()).verdict == "registered"
    thick = replace(seen, offsets=torch.tensor([0.016]))
    assert decide(thick, 0, 0, RobustOptions()).verdict == "rejected"
    little = replace(judged([0.02] * 10, [0.02] * 3 + [-0.1] * 7), partial=True)
    assert decide(little, 0, 0, RobustOptions()).verdict == "rejected"
    assert decide(little, 0, 0, RobustOptions(), incoherence=ROUGH).verdict == "rejected"


@given(
    forth=st.lists(st.floats(-0.2, 0.2), min_size=4, max_size=12),
    back=st.lists(st.floats(-0.2, 0.2), min_size=4, max_size=12),
    incoherence=st.floats(0.0, 0.1),
    partial=st.booleans(),
)
def test_the_margin_is_negative_for_rejections_alone(
    forth: list[float], back: list[float], incoherence: float, partial: bool
) -> None:
    decision = decide(replace(judged(forth, back), partial=partial), 0, 0, RobustOptions(), incoherence)
    assert (decision.margin < 0.0) == (decision.verdict == "rejected")
    assert decision.margin <= 1.0


def test_numbers_that_are_none_are_rejected() -> None:
    nothing = float("nan")
    assert decide(judged([nothing] * 5, [nothing] * 5), 0, 0, RobustOptions(), incoherence=ROUGH).verdict == "rejected"
