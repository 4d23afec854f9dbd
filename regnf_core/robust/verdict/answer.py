"""The best candidate, the alternatives that match the verification samples equally well, and their probabilities."""

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

# The margin of a pose over the best pose that is another answer.
#
# Poses are ranked by log-odds minus a multiple of the score. The log-odds separate poses that fit from those that do
# not, and the score ranks the poses that fit. A correct pose is clearly better than all others of the search. If the
# object is not in the box, or if the search lost the correct pose, several poses have similar log-odds.
#
# An answer may list several poses that fit equally well, of which one is correct. They do not compete with the answer
# as a whole.


def merits(log_odds: Tensor, scores: Tensor) -> Tensor:
    """Ranking values (H,) of poses, in log-odds, larger is better. log_odds: (H,), that the pose is correct, without
    regard to the other poses · scores: (H,), 0..1, smaller is better."""
    return log_odds - VERDICT.log_odds_per_score * scores.to(log_odds)


def leads(merits: Tensor, apart: Tensor) -> Tensor:
    """Margins (H,): the ranking value (H,) of each pose minus that of the best pose ``apart`` (H, H) from it. At most
    VERDICT.most_lead, which is also the margin of a pose without such a pose."""
    others = torch.where(apart, merits, -torch.inf).amax(1)
    return (merits - others).clamp(-VERDICT.most_lead, VERDICT.most_lead)


def apart_from_answer(apart: Tensor, answer: Sequence[int]) -> Tensor:
    """(H, H) as ``apart``, but a pose of the ``answer`` (given by its indices) is apart only from poses that are apart
    from all poses of the answer."""
    joined = apart.clone()
    joined[list(answer)] = apart[list(answer)].all(0)
    return joined


def apart(T: Sim3, points: Tensor, symmetry: SelfSymmetry) -> Tensor:
    """(H, H) bool: which pairs of the poses T (H,) place the object differently, up to its symmetries.

    points: (E, 3), the object's outermost ones. Two poses are apart if they place one of them more than VERDICT.apart
    diameters apart. The diagonal is False.
    """
    points = points.double()
    placed = T.apply_inverse(points)
    alike = alike_poses(symmetry).apply_inverse(points)
    rows = []
    for number in range(len(T)):
        pose = T[number]
        equivalents = pose.apply_inverse(alike.reshape(-1, 3)).reshape(alike.shape)
        far = (placed[:, None] - equivalents).norm(dim=-1).amax(-1).amin(-1)
        rows.append(pose.scale * far > VERDICT.apart)
    return torch.stack(rows)


def alike_poses(symmetry: SelfSymmetry) -> Sim3:
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
# There are two such models. The pose model (``alone``) uses only the pose. The decision model (``among``) also
# compares it with the other candidates: its additional feature is the margin over the best other answer (`leads`).
#
# "Right" means within 5 % of the object's diameter of the true pose, or of a symmetry equivalent of it. The functions
# are data, made by ``python -m benchmarks.worlds train`` from random worlds (docs/verdict.md).
# There are three decision models: one for scenes with an observation, one for scenes without. The meaning of a feature
# depends on it: a network invents surface where no camera looked, and only an observation identifies this surface. The
# third one is for detections in an image, which define the object's surface: only this surface is sampled, only one
# side of the object is observed, and the depths of one image are noisier than a map.

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
    """The two models. among_hidden: the decision model for an object that is mostly hidden at the best pose; None: the
    same.

    A field of one depth image is solid behind the observed surface, so it contains the information of an observation.
    The model for scenes without an observation was trained on scenes with surface on most sides of an object.
    """

    alone: ProbabilityModel
    among: ProbabilityModel
    among_hidden: ProbabilityModel | None = None

    def log_odds(self, features: dict[str, Tensor], scores: Tensor, apart: Tensor) -> Tensor:
        """(H,): log-odds of the candidates, each compared with the others.

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
    """The models of this release. observed: whether the scene has an observation · of_thing: whether a
    detection defines the object's surface."""
    models = _stored()
    among = models["thing" if of_thing else "observed" if observed else "unobserved"]
    return PoseOdds(models["alone"], among, None if observed else models["observed"])


@cache
def _stored() -> dict[str, ProbabilityModel]:
    stored = json.loads(files(__package__).joinpath(_MODELS).read_text())
    return {name: ProbabilityModel.from_dict(model) for name, model in stored.items()}


@dataclass(frozen=True, eq=False)
class Answer:
    """The best of H candidates on the verification samples, and its alternatives, which match these equally well, best
    first.

    scores: (H,), 0..1, smaller is better · demerits: (H,), ranking values of the candidates, smaller is better, see
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
    """Relations between H poses, each (H, H).

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
