"""The probability model: its terms by hand, monotone in every feature, and the file that is shipped."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from regnf_core.robust.constants import VERDICT
from regnf_core.robust.verdict.answer import LEAD, PoseOdds, ProbabilityModel, pose_odds
from regnf_core.robust.verdict.evidence import SPEAKS_FOR

STORED: dict[str, Any] = {
    "bias": 2.0,
    "terms": {
        "confirmed": {"knots": [0.2, 0.6, 0.8], "values": [-3.0, -1.0, 0.0]},
        "free": {"knots": [0.0, 0.5], "values": [0.0, -4.0]},
    },
}


def features(**values: float) -> dict[str, torch.Tensor]:
    return {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}


def logit(**values: float) -> float:
    return float(ProbabilityModel.from_dict(STORED).logit(features(**values))[0])


def test_terms_by_hand() -> None:
    assert logit(confirmed=0.9, free=0.0) == pytest.approx(2.0)
    assert logit(confirmed=0.4, free=0.0) == pytest.approx(2.0 - 2.0)  # half way between -3 and -1
    assert logit(confirmed=0.7, free=0.25) == pytest.approx(2.0 - 0.5 - 2.0)
    assert logit(confirmed=0.0, free=0.9) == pytest.approx(2.0 - 3.0 - 4.0)  # constant beyond the outer knots


def test_what_is_not_a_number_is_as_bad_as_can_be() -> None:
    assert logit(confirmed=math.nan, free=0.0) == pytest.approx(2.0 - 3.0)
    assert logit(confirmed=0.9, free=math.inf) == pytest.approx(2.0 - 4.0)


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
    """Two candidates; at the better one half of the object is hidden, as the field of one depth image says. The patches
    that are hidden must not speak against it then, nor against the other, whose own share is not asked."""
    told = {name: torch.full((2,), 0.5).double() for name in SPEAKS_FOR} | {"hidden": torch.tensor([hidden, 0.1])}
    told |= {"confirmed": torch.tensor([0.6, 0.1])}
    scores, apart = torch.tensor([0.2, 0.4]), ~torch.eye(2, dtype=torch.bool)
    found = pose_odds(False).log_odds(told, scores, apart)
    known = pose_odds(True).log_odds(told, scores, apart)
    assert torch.equal(found, known) is as_if_observed
    fewer = {**told, "confirmed_patches": torch.zeros(2)}
    assert torch.equal(pose_odds(False).log_odds(fewer, scores, apart), found) is as_if_observed


OBSERVED = pytest.mark.parametrize("observed", [True, False])


@OBSERVED
@given(name=st.sampled_from(sorted(SPEAKS_FOR)), low=st.floats(-3.0, 3.0), step=st.floats(0.0, 3.0))
def test_the_shipped_models_are_monotone(observed: bool, name: str, low: float, step: float) -> None:
    others = {feature: torch.full((2,), 0.5, dtype=torch.float64) for feature in SPEAKS_FOR}
    changed = others | {name: torch.tensor([low, low + step], dtype=torch.float64)}
    odds, single = pose_odds(observed), torch.zeros(2, 2, dtype=torch.bool)
    for logits in (odds.alone.logit(changed), odds.log_odds(changed, torch.full((2,), 0.3), single)):
        less, more = logits.tolist()
        assert more >= less if SPEAKS_FOR[name] else more <= less


@OBSERVED
def test_the_shipped_models_use_what_they_must(observed: bool) -> None:
    """A pose that is perfect in all respects is likely; one in free space, or without any agreement, is not; one of two
    perfect poses is less likely than a single one."""
    best = {name: torch.tensor([1e3 if better else -1e3] * 2).double() for name, better in SPEAKS_FOR.items()}
    worst = {name: -values for name, values in best.items()}
    single, several = torch.zeros(2, 2, dtype=torch.bool), ~torch.eye(2, dtype=torch.bool)
    alike = torch.full((2,), 0.3)
    odds = pose_odds(observed)
    likely = float(odds.log_odds(best, alike, single)[0].sigmoid())
    assert likely > 0.98, "among the others: what results tell"
    for logits in (odds.alone.logit(worst), odds.log_odds(worst, alike, single)):
        assert float(logits[0].sigmoid()) < 1e-4
    assert float(odds.log_odds(best, alike, several)[0].sigmoid()) < likely
