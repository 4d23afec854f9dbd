"""Which candidate is the best, which others explain the held-out samples as well, and how likely they are right."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from regnf_core.geometry.pose_distance import distinct
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import EVIDENCE, VERDICT
from regnf_core.robust.model.object_model import ObjectModel
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.verdict.lead import apart, apart_from_answer, merits
from regnf_core.robust.verdict.probability import pose_odds


@dataclass(frozen=True, eq=False)
class Answer:
    """The best of H candidates by the held-out samples, and its rivals, which explain these as well, best first.

    scores: (H,), 0..1, smaller is better · demerits: (H,), what candidates are compared by, smaller is better, see
    :func:`regnf_core.robust.verdict.lead.merits` · probability: (H,), that the candidate is right, where those that
    place the object elsewhere compete with it, but the best one and those of its rivals that place nearly the same
    surface do not compete with each other: of those, that one of them is right · probability_alone: (H,), the same
    where these compete too: that this very pose is right.
    """

    winner: int
    rivals: list[int]
    scores: Tensor
    demerits: Tensor
    probability: Tensor
    probability_alone: Tensor


def choose(
    problem: RegistrationProblem,
    candidates: PoseCandidates,
    features: dict[str, Tensor],
    scores: Tensor,
    rival_margin: float,
) -> Answer:
    """The answer from the candidates' features, each (H,), and scores (H,), all on the CPU."""
    odds = pose_odds(problem.view.observation is not None)
    alone, scores = odds.alone.logit(features), scores.double()
    demerits = -merits(alone, scores)
    winner = int(demerits.argmin())
    close = scores <= scores[winner] + rival_margin + VERDICT.rival_margin_per_score * scores[winner]
    close &= alone >= alone[winner] - VERDICT.rival_log_odds
    points = problem.model.extremal_points
    ranked = distinct(candidates.T, demerits, points, VERDICT.rivals_min_distance, len(candidates))
    rivals = [number for number in ranked.tolist() if number != winner and close[number]]
    elsewhere = apart(candidates.T, points, problem.model.symmetry)
    likely_alone = odds.log_odds(features, scores, elsewhere).sigmoid()
    alike = [number for number in rivals if _places_the_same(problem.model, candidates.T, number, winner)]
    likely = odds.log_odds(features, scores, apart_from_answer(elsewhere, [winner, *alike])).sigmoid()
    return Answer(winner, rivals, scores, demerits, likely, likely_alone)


def _places_the_same(model: ObjectModel, T: Sim3, one: int, other: int) -> bool:
    """Whether two of the poses T (H,) place nearly the same surface in the scene, as the poses of an object do that
    looks nearly the same when it is turned. Other poses that fit alike speak against all of them: another object's do.
    """
    moved = (T[one] @ T[other].inverse()).apply(model.samples.on_surface().double()).float()
    distances, _ = model.distance_grid.value_and_gradient(moved)
    return float((distances.abs() <= EVIDENCE.agreement).float().mean()) >= VERDICT.min_same_surface
