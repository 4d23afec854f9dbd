"""The probability that a pose is right, from its features: a sum of functions, each monotone in one feature.

    logit P(right) = b + sum_k f_k(x_k),    f_k piecewise linear, increasing or decreasing as SPEAKS_FOR says

There are two such sums. One knows the pose ``alone``. The other knows the candidates ``among`` which it is: its further
feature is the pose's lead, how far its log odds alone, less the score's share, lie above those of the next other answer
(:mod:`.lead`).

"Right" means within 5 % of the object's diameter of the true pose, or of one that the object's symmetries make equal.
The functions are data, made by ``python -m benchmarks.worlds train`` from random worlds (docs/verdict.md). The second
sum has two models: one for scenes of which it is known what was seen, one for the others. What a feature tells depends
on that: a field has surface that nobody saw, and only an observation says which it is.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import torch
from torch import Tensor

from regnf_core.robust.constants import VERDICT
from regnf_core.robust.verdict.lead import leads, merits
from regnf_core.robust.verdict.pose_features import SPEAKS_FOR

LEAD = "lead"
SPEAKS_FOR_AMONG = {**SPEAKS_FOR, LEAD: True}
_ALONE = "probability-alone.json"
_AMONG = {True: "probability-observed.json", False: "probability-unobserved.json"}


@dataclass(frozen=True, eq=False)
class Term:
    """A piecewise linear function of one feature: its values at increasing knots; constant beyond the outer ones."""

    feature: str
    knots: Tensor
    values: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        """The function's values at x (H,)."""
        x = x.clamp(self.knots[0], self.knots[-1])
        right = torch.searchsorted(self.knots, x).clamp(1, len(self.knots) - 1)
        low, high = self.knots[right - 1], self.knots[right]
        share = (x - low) / (high - low)
        return torch.lerp(self.values[right - 1], self.values[right], share)


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
        spoken = self.against(features)
        return self.bias + torch.stack(list(spoken.values())).sum(0)

    def against(self, features: dict[str, Tensor]) -> dict[str, Tensor]:
        """What each feature speaks against the poses, (H,), in logits: 0 where it is at its best, else negative."""
        return {term.feature: _worst_if_nan(term, features[term.feature].double()) for term in self.terms}


def _worst_if_nan(term: Term, x: Tensor) -> Tensor:
    return torch.where(x.isnan(), term.values.min(), term(x.nan_to_num(0.0)))


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
def pose_odds(observed: bool) -> PoseOdds:
    """The models that are shipped. observed: whether it is known what was seen of the scene."""
    among = _stored(_AMONG[observed], "among")
    return PoseOdds(_stored(_ALONE, "alone"), among, None if observed else _stored(_AMONG[True], "among"))


def _stored(name: str, model: str) -> ProbabilityModel:
    return ProbabilityModel.from_dict(json.loads(files(__package__).joinpath(name).read_text())[model])
