"""Which candidate is the best, which others explain the held-out samples as well, and how likely they are right."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from regnf_core.geometry.pose_distance import distinct
from regnf_core.robust.constants import VERDICT
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.verdict.lead import apart, apart_from_answer, merits
from regnf_core.robust.verdict.probability import pose_odds


@dataclass(frozen=True, eq=False)
class Answer:
    """The best of H candidates by the held-out samples, and its rivals, which explain these as well, best first.

    scores: (H,), 0..1, smaller is better · demerits: (H,), what candidates are compared by, smaller is better, see
    :func:`regnf_core.robust.verdict.lead.merits` · probability: (H,), that the candidate is right, where all others
    that place the object elsewhere compete with it · probability_listed: (H,), the same where the best one and its
    rivals do not compete with each other: of those, that one of them is right.
    """

    winner: int
    rivals: list[int]
    scores: Tensor
    demerits: Tensor
    probability: Tensor
    probability_listed: Tensor


def choose(
    problem: RegistrationProblem,
    candidates: PoseCandidates,
    features: dict[str, Tensor],
    scores: Tensor,
    rival_margin: float,
) -> Answer:
    """The answer from the candidates' features, each (H,), and scores (H,), all on the CPU."""
    odds = pose_odds()
    alone, scores = odds.alone.logit(features), scores.double()
    demerits = -merits(alone, scores)
    winner = int(demerits.argmin())
    close = scores <= scores[winner] + rival_margin + VERDICT.rival_margin_per_score * scores[winner]
    close &= alone >= alone[winner] - VERDICT.rival_log_odds
    points = problem.model.extremal_points
    ranked = distinct(candidates.T, demerits, points, VERDICT.rivals_min_distance, len(candidates))
    rivals = [number for number in ranked.tolist() if number != winner and close[number]]
    elsewhere = apart(candidates.T, points, problem.model.symmetry)
    likely = odds.log_odds(features, scores, elsewhere).sigmoid()
    listed = odds.log_odds(features, scores, apart_from_answer(elsewhere, [winner, *rivals])).sigmoid()
    return Answer(winner, rivals, scores, demerits, likely, listed)
