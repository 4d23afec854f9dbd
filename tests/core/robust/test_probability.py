"""The probability model: its terms by hand, monotone in every feature, and the file that is shipped."""

from __future__ import annotations

import math
from math import cos, sin
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import VERDICT
from regnf_core.robust.model import SelfSymmetry
from regnf_core.robust.search.bounds import turns_about
from regnf_core.robust.verdict.answer import (
    LEAD,
    PoseOdds,
    ProbabilityModel,
    apart,
    apart_from_answer,
    leads,
    merits,
    pose_odds,
)
from regnf_core.robust.verdict.evidence import SPEAKS_FOR

STORED: dict[str, Any] = {
    "bias": 2.0,
    "terms": {
        "confirmed": {"knots": [0.2, 0.6, 0.8], "values": [-3.0, -1.0, 0.0]},
        "free": {"knots": [0.0, 0.5], "values": [0.0, -4.0]},
    },
}


@pytest.mark.parametrize(
    ("confirmed", "free", "expected"),
    [
        (0.9, 0.0, 2.0),
        (0.4, 0.0, 2.0 - 2.0),  # half way between -3 and -1
        (0.7, 0.25, 2.0 - 0.5 - 2.0),
        (0.0, 0.9, 2.0 - 3.0 - 4.0),  # constant beyond the outer knots
        (math.nan, 0.0, 2.0 - 3.0),  # no number is as bad as can be
        (0.9, math.inf, 2.0 - 4.0),
    ],
)
def test_terms_by_hand(confirmed: float, free: float, expected: float) -> None:
    told = {
        "confirmed": torch.tensor([confirmed], dtype=torch.float64),
        "free": torch.tensor([free], dtype=torch.float64),
    }
    assert float(ProbabilityModel.from_dict(STORED).logit(told)[0]) == pytest.approx(expected)


@pytest.mark.parametrize(
    "broken",
    [
        {"confirmed": {"knots": [0.2, 0.6, 0.8], "values": [-1.0, -3.0, 0.0]}},  # more of it must speak for the pose
        {"free": {"knots": [0.0, 0.5], "values": [-4.0, 0.0]}},  # more of it must speak against the pose
        {"free": {"knots": [0.5, 0.0], "values": [0.0, -4.0]}},
    ],
)
def test_a_file_whose_terms_are_not_monotone_is_refused(broken: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="not monotone"):
        ProbabilityModel.from_dict({"bias": 0.0, "terms": broken})


def test_the_lead_is_taken_from_the_odds_alone_and_the_scores() -> None:
    """Three candidates; the first two are one answer, so the lead of each is over the third. The third's score is worse
    by what 1.5 log odds weigh."""
    alone = ProbabilityModel.from_dict(STORED)
    among = ProbabilityModel.from_dict({"bias": 1.0, "terms": {LEAD: {"knots": [-1.0, 3.0], "values": [-4.0, 0.0]}}})
    elsewhere = torch.tensor([[False, False, True], [False, False, True], [True, True, False]])
    told = {"confirmed": torch.tensor([0.9, 0.7, 0.6]), "free": torch.zeros(3)}
    scores = torch.tensor([0.3, 0.3, 0.3]).double()
    assert alone.logit(told).tolist() == pytest.approx([2.0, 1.5, 1.0])
    found = PoseOdds(alone, among).log_odds(told, scores, elsewhere)
    assert found.tolist() == pytest.approx([1.0 - 2.0, 1.0 - 2.5, 1.0 - 4.0])  # leads 1, .5 and -1
    scores[2] += 1.5 / VERDICT.log_odds_per_score
    found = PoseOdds(alone, among).log_odds(told, scores, elsewhere)
    assert found.tolist() == pytest.approx([1.0 - 0.5, 1.0 - 1.0, 1.0 - 4.0], abs=1e-6)  # leads 2.5, 2 and -2.5


@pytest.mark.parametrize(("hidden", "as_if_observed"), [(0.45, False), (0.55, True)])
def test_what_is_mostly_hidden_at_the_best_pose_is_known_to_be(hidden: float, as_if_observed: bool) -> None:
    """Two candidates; at the better one half of the object is hidden, as the field of one depth image says. The scene
    counts as one of which it is known what was seen then, also for the other, whose own share is not asked."""
    told = {name: torch.full((2,), 0.5).double() for name in SPEAKS_FOR} | {"hidden": torch.tensor([hidden, 0.1])}
    told |= {name: torch.tensor([0.9, 0.1]) for name in ("confirmed", "object_agrees", "scene_agrees")}
    scores, apart = torch.tensor([0.2, 0.4]), ~torch.eye(2, dtype=torch.bool)
    found = pose_odds(False).log_odds(told, scores, apart)
    known = pose_odds(True).log_odds(told, scores, apart)
    assert torch.equal(found, known) is as_if_observed


ODDS = pytest.mark.parametrize("odds", [pose_odds(True), pose_odds(False), pose_odds(True, of_thing=True)])


@ODDS
@given(name=st.sampled_from(sorted(SPEAKS_FOR)), low=st.floats(-3.0, 3.0), step=st.floats(0.0, 3.0))
def test_the_shipped_models_are_monotone(odds: PoseOdds, name: str, low: float, step: float) -> None:
    others = {feature: torch.full((2,), 0.5, dtype=torch.float64) for feature in SPEAKS_FOR}
    changed = others | {name: torch.tensor([low, low + step], dtype=torch.float64)}
    single = torch.zeros(2, 2, dtype=torch.bool)
    for logits in (odds.alone.logit(changed), odds.log_odds(changed, torch.full((2,), 0.3), single)):
        less, more = logits.tolist()
        assert more >= less if SPEAKS_FOR[name] else more <= less


@ODDS
def test_the_shipped_models_use_what_they_must(odds: PoseOdds) -> None:
    """A pose that is perfect in all respects is likely; one in free space, or without any agreement, is not; one of two
    perfect poses is less likely than a single one."""
    best = {name: torch.tensor([1e3 if better else -1e3] * 2).double() for name, better in SPEAKS_FOR.items()}
    worst = {name: -values for name, values in best.items()}
    single, several = torch.zeros(2, 2, dtype=torch.bool), ~torch.eye(2, dtype=torch.bool)
    alike = torch.full((2,), 0.3)
    likely = float(odds.log_odds(best, alike, single)[0].sigmoid())
    assert likely > 0.98, "among the others: what results tell"
    for logits in (odds.alone.logit(worst), odds.log_odds(worst, alike, single)):
        assert float(logits[0].sigmoid()) < 1e-4
    assert float(odds.log_odds(best, alike, several)[0].sigmoid()) < likely


# Leads of poses over other answers, by hand: near poses and symmetric ones are the same answer.


POINTS = torch.tensor([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.4]])
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


NO_SYMMETRY = SelfSymmetry(Sim3.identity()[None][:0], None, torch.zeros(0))


def turns(*angles: float) -> Sim3:
    """Turns about the upright axis, as transforms (K,)."""
    none = torch.zeros(len(angles), 3, dtype=torch.float64)
    rotations = torch.tensor(
        [[[cos(a), -sin(a), 0.0], [sin(a), cos(a), 0.0], [0.0, 0.0, 1.0]] for a in angles]
    ).double()
    return Sim3(torch.ones(len(angles)).double(), rotations, none)


@pytest.mark.parametrize("scale", [0.05, 1.0, 20.0])
def test_poses_are_apart_beyond_a_twentieth_of_the_diameter_whatever_the_scale(scale: float) -> None:
    shifts = torch.tensor([[0.0, 0.0, 0.0], [0.04, 0.0, 0.0], [0.06, 0.0, 0.0]]).double()
    T = Sim3(torch.full((3,), scale).double(), torch.eye(3).double().expand(3, 3, 3), shifts)
    expected = [[False, False, True], [False, False, False], [True, False, False]]
    assert apart(T, POINTS, NO_SYMMETRY).tolist() == expected


def test_symmetric_poses_are_one_answer() -> None:
    T = turns(0.0, math.pi, math.pi / 2)
    half = SelfSymmetry(turns(math.pi), None, torch.zeros(1))
    assert apart(T, POINTS, half).tolist() == [[False, False, True], [False, False, True], [True, True, False]]
    nearly = SelfSymmetry(turns(math.pi), None, torch.ones(1))  # the object's field does not confirm it
    assert apart(T, POINTS, nearly)[0].tolist() == [False, True, True]


def test_turns_about_an_axis_of_symmetry_are_one_answer() -> None:
    axis = SelfSymmetry(Sim3.identity()[None][:0], UP, torch.zeros(0))
    tilted = Sim3(torch.ones(1).double(), turns_about(UP.roll(1), 4)[1:2], torch.zeros(1, 3).double())
    T = Sim3.cat([turns(0.0, 0.3, 2.0), tilted])
    assert apart(T, POINTS, axis).tolist()[0] == [False, False, False, True]


def test_leads_by_hand() -> None:
    elsewhere = torch.tensor([[False, False, True], [False, False, True], [True, True, False]])
    found = leads(torch.tensor([2.0, 1.0, 0.5]).double(), elsewhere)
    assert found.tolist() == pytest.approx([1.5, 0.5, -1.5])


def test_poses_of_one_answer_lead_over_what_is_apart_from_all_of_them() -> None:
    """0 and 1 are listed; 2 lies near 1, 3 elsewhere. Only 3 competes with the answer; 2 and 3 have their rivals."""
    elsewhere = torch.tensor(
        [[False, True, True, True], [True, False, False, True], [True, False, False, True], [True, True, True, False]]
    )
    joined = apart_from_answer(elsewhere, [0, 1])
    assert joined[:2].tolist() == [[False, False, False, True]] * 2
    assert joined[2:].tolist() == elsewhere[2:].tolist()
    found = leads(torch.tensor([2.0, 1.9, 1.8, 0.5]).double(), joined)
    assert found.tolist() == pytest.approx([1.5, 1.4, -0.2, -1.5])


def test_of_poses_that_are_about_as_likely_the_better_score_has_the_merit() -> None:
    found = merits(torch.tensor([1.0, 0.5, -3.0]).double(), torch.tensor([0.40, 0.35, 0.35]))
    assert found.argmax() == 1
    assert found[1] - found[2] == pytest.approx(3.5), "the odds count where the scores are alike"
