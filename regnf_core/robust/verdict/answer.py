"""Which candidate is the best, which others explain the held-out samples as well, and how likely they are right."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.geometry.metrics import displacement
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import EVIDENCE, MODEL, VERDICT
from regnf_core.robust.model import ObjectModel, SelfSymmetry
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.search.bounds import turns_about
from regnf_core.robust.verdict.evidence import SPEAKS_FOR

# By how much a pose is better than the next one that is another answer.
#
# Poses are compared by their merits: the log odds say which of them fit at all, the score says which of these fits
# best. A pose that is right stands out among all that a search found. Where an object is not in the box, or the right
# pose was lost, several poses are about as likely.
#
# An answer may list several poses that fit alike, of which one is right. They are no rivals of the answer as a whole.


def merits(log_odds: Tensor, scores: Tensor) -> Tensor:
    """(H,) in log odds, larger is better: what poses with these log odds (H,) of being right, each alone, and scores
    (H,), 0..1, smaller is better, are compared by."""
    return log_odds - VERDICT.log_odds_per_score * scores.to(log_odds)


def leads(merits: Tensor, apart: Tensor) -> Tensor:
    """(H,): each pose's merit (H,) above that of the best of the poses that are ``apart`` (H, H) from it, at most
    VERDICT.most_lead, which is also the lead of a pose without any."""
    others = torch.where(apart, merits, -torch.inf).amax(1)
    return (merits - others).clamp(-VERDICT.most_lead, VERDICT.most_lead)


def apart_from_answer(apart: Tensor, answer: Sequence[int]) -> Tensor:
    """(H, H) as ``apart``, but a pose of the ``answer``, given by their numbers, is apart only from poses that are
    apart from all of them."""
    joined = apart.clone()
    joined[list(answer)] = apart[list(answer)].all(0)
    return joined


def apart(T: Sim3, points: Tensor, symmetry: SelfSymmetry) -> Tensor:
    """(H, H) bool: which of the poses T (H,) place the object elsewhere than which, its symmetries allowed for.

    points: (E, 3), the object's outermost ones. Two poses are apart if they place one of them more than VERDICT.apart
    diameters apart. The diagonal is False.
    """
    points = points.double()
    placed = T.apply_inverse(points)
    alike = _alike(symmetry).apply_inverse(points)
    rows = []
    for number in range(len(T)):
        pose = T[number]
        equivalents = pose.apply_inverse(alike.reshape(-1, 3)).reshape(alike.shape)
        far = (placed[:, None] - equivalents).norm(dim=-1).amax(-1).amin(-1)
        rows.append(pose.scale * far > VERDICT.apart)
    return torch.stack(rows)


def _alike(symmetry: SelfSymmetry) -> Sim3:
    """(K,) the object's symmetries, the identity among them, with turns about its axis in small steps."""
    identity = Sim3.identity()[None]
    exact = Sim3.cat([identity, symmetry.T[symmetry.deviation <= MODEL.max_deviating_share]])
    if symmetry.axis is None:
        return exact
    rotations = turns_about(symmetry.axis, VERDICT.axis_turns)
    turns = Sim3(torch.ones(len(rotations)).double(), rotations, torch.zeros(len(rotations), 3).double())
    return Sim3.cat([turn[None] @ exact for turn in turns])


# The probability that a pose is right, from its features: a sum of functions, each monotone in one feature.
#
#     logit P(right) = b + sum_k f_k(x_k),    f_k piecewise linear, increasing or decreasing as SPEAKS_FOR says
#
# There are two such sums. One knows the pose ``alone``. The other knows the candidates ``among`` which it is: its
# further feature is the pose's lead, how far its log odds alone, less the score's share, lie above those of the next
# other answer (`leads`).
#
# "Right" means within 5 % of the object's diameter of the true pose, or of one that the object's symmetries make
# equal. The functions are data, made by ``python -m benchmarks.worlds train`` from random worlds (docs/verdict.md).
# The second sum has several models: one for scenes of which it is known what was seen, one for the others. What a
# feature tells depends on that: a field has surface that nobody saw, and only an observation says which it is. Where a
# detection in an image says which surface is the instance's, it has a third one: nothing else is sampled, one side of
# the thing was seen, and depths of one image are noisier than a map.

LEAD = "lead"
SPEAKS_FOR_AMONG = {**SPEAKS_FOR, LEAD: True}
_MODELS = "probability.json"


@dataclass(frozen=True, eq=False)
class Term:
    """A piecewise linear function of one feature: its values at increasing knots; constant beyond the outer ones."""

    feature: str
    knots: Tensor
    values: Tensor

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """The function's values at x (H,). What is not a number is as bad as can be."""
        values = self.values.numpy()
        found: NDArray[np.float64] = np.where(np.isnan(x), values.min(), np.interp(x, self.knots.numpy(), values))
        return found


@dataclass(frozen=True, eq=False)
class ProbabilityModel:
    """bias: logit where every term is at its best value, 0 · terms: at most 0, one for each feature that counts."""

    bias: float
    terms: tuple[Term, ...]

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> ProbabilityModel:
        """The model that a file holds. Raises ValueError for a term that is not monotone as its feature must be."""
        terms = tuple(
            Term(name, *(torch.tensor(one[part], dtype=torch.float64) for part in ("knots", "values")))
            for name, one in stored["terms"].items()
        )
        for term in terms:
            steps = term.values.diff() * (1 if SPEAKS_FOR_AMONG[term.feature] else -1)
            if not (bool((steps >= 0).all()) and bool((term.knots.diff() > 0).all())):
                raise ValueError(f"the term of {term.feature} is not monotone")
        return cls(float(stored["bias"]), terms)

    def logit(self, features: dict[str, Tensor]) -> Tensor:
        """(H,) log odds of the poses with these features, each (H,). What is not a number is as bad as can be."""
        return self.bias + torch.stack(list(self.against(features).values())).sum(0)

    def against(self, features: dict[str, Tensor]) -> dict[str, Tensor]:
        """What each feature speaks against the poses, (H,), in logits: 0 where it is at its best, else negative."""
        # Plain arrays: a call costs less there, and all of them are small.
        return {term.feature: torch.from_numpy(term(features[term.feature].double().numpy())) for term in self.terms}


@dataclass(frozen=True, eq=False)
class PoseOdds:
    """The two sums. among_hidden: the second one where the object is mostly hidden at the best pose; None: the same.

    A field of one depth image is solid behind what was seen, so it says itself what was hidden, as an observation does.
    The scenes of which nothing is known, from which their model has learned, show surface on most sides of an object.
    """

    alone: ProbabilityModel
    among: ProbabilityModel
    among_hidden: ProbabilityModel | None = None

    def log_odds(self, features: dict[str, Tensor], scores: Tensor, apart: Tensor) -> Tensor:
        """(H,): log odds of the candidates, each as one among them.

        features: each (H,) · scores: (H,), smaller is better · apart: (H, H) bool, which candidates are other answers
        than which.
        """
        compared = merits(self.alone.logit(features), scores)
        model = self.among
        if self.among_hidden is not None and float(features["hidden"][compared.argmax()]) > VERDICT.mostly_hidden:
            model = self.among_hidden
        return model.logit({**features, LEAD: leads(compared, apart)})


@cache
def pose_odds(observed: bool, of_thing: bool = False) -> PoseOdds:
    """The models that are shipped. observed: whether it is known what was seen of the scene · of_thing: whether a
    detection said which surface is the object's."""
    models = _stored()
    among = models["thing" if of_thing else "observed" if observed else "unobserved"]
    return PoseOdds(models["alone"], among, None if observed else models["observed"])


@cache
def _stored() -> dict[str, ProbabilityModel]:
    stored = json.loads(files(__package__).joinpath(_MODELS).read_text())
    return {name: ProbabilityModel.from_dict(model) for name, model in stored.items()}


@dataclass(frozen=True, eq=False)
class Answer:
    """The best of H candidates by the held-out samples, and its rivals, which explain these as well, best first.

    scores: (H,), 0..1, smaller is better · demerits: (H,), what candidates are compared by, smaller is better, see
    :func:`regnf_core.robust.verdict.answer.merits` · probability: (H,), that the candidate is right, where those that
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


@dataclass(frozen=True, eq=False)
class Relations:
    """How H poses lie to each other, each (H, H).

    moved: how far the second places the object from the first, diameters · apart: bool, whether they are other answers,
    see `apart` · same: see `same_surface`.
    """

    moved: Tensor
    apart: Tensor
    same: Callable[[int, int], float]

    @classmethod
    def of(cls, model: ObjectModel, T: Sim3) -> Relations:
        """Of poses of an object."""
        points = model.extremal_points
        moved = torch.stack([displacement(T, one, points) for one in T])
        return cls(moved, apart(T, points, model.symmetry), lambda one, other: same_surface(model, T, one, other))


def choose(
    problem: RegistrationProblem,
    candidates: PoseCandidates,
    features: dict[str, Tensor],
    scores: Tensor,
    rival_margin: float,
) -> Answer:
    """The answer from the candidates' features, each (H,), and scores (H,), all on the CPU."""
    observation = problem.view.observation
    odds = pose_odds(observation is not None, observation is not None and observation.of_thing)
    return answer_of(odds, features, scores, Relations.of(problem.model, candidates.T), rival_margin)


def answer_of(
    odds: PoseOdds, features: dict[str, Tensor], scores: Tensor, poses: Relations, rival_margin: float
) -> Answer:
    """The answer among poses of which these relations are known."""
    alone, scores = odds.alone.logit(features), scores.double()
    demerits = -merits(alone, scores)
    winner = int(demerits.argmin())
    close = scores <= scores[winner] + rival_margin + VERDICT.rival_margin_per_score * scores[winner]
    close &= alone >= alone[winner] - VERDICT.rival_log_odds
    rivals = [one for one in _distinct(demerits, poses.moved) if one != winner and close[one]]
    likely_alone = odds.log_odds(features, scores, poses.apart).sigmoid()
    alike = [one for one in rivals if poses.same(one, winner) >= VERDICT.min_same_surface]
    likely = odds.log_odds(features, scores, apart_from_answer(poses.apart, [winner, *alike])).sigmoid()
    return Answer(winner, rivals, scores, demerits, likely, likely_alone)


def _distinct(demerits: Tensor, moved: Tensor) -> list[int]:
    """Numbers of the poses, the best first, but for those that lie close to a better one."""
    chosen: list[int] = []
    for number in demerits.argsort().tolist():
        if all(float(moved[one, number]) >= VERDICT.rivals_min_distance for one in chosen):
            chosen.append(number)
    return chosen


def same_surface(model: ObjectModel, T: Sim3, one: int, other: int) -> float:
    """Share of the object's surface that two of the poses T (H,) place on its surface by the other one: of an object
    that looks nearly the same when it is turned, nearly all. Other poses that fit alike speak against all of them:
    another object's do."""
    moved = (T[one] @ T[other].inverse()).apply(model.samples.on_surface().double()).float()
    distances, _ = model.distance_grid.value_and_gradient(moved)
    return float((distances.abs() <= EVIDENCE.agreement).float().mean())
