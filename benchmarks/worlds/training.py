"""The probability model of the verdict, trained on evidence from random worlds: ``python -m benchmarks.worlds train``.

Logistic regression on monotone ramps: each feature's range is cut at quantiles, and each piece has a ramp whose weight
is at least 0, so the sum is monotone in every feature. Worlds are left out in turn to see what the model says of rooms
that it does not know; what it says of them is then made right on average (Platt's scaling on the left-out logits).

Look-alikes and other objects of a similar shape are measured, not trained with: in a noisy map the right object cannot
be told from one that differs by a part, or by little everywhere, so how probable it is would be a matter of how many
such objects the training has.

A model knows a pose alone, or it is given such a model and knows one feature more: the lead that those log odds give a
pose over the other answers among the same candidates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from benchmarks.robust.judging import SUCCESS
from benchmarks.worlds.calibration import calibration_table, measured_line
from benchmarks.worlds.comparing import compared_line
from benchmarks.worlds.look_alikes import LOOK_ALIKE
from benchmarks.worlds.recipe import parts_of_name
from benchmarks.worlds.reliability import reliability_diagram
from benchmarks.worlds.similar_objects import SIMILAR
from regnf_core.robust.constants import VERDICT
from regnf_core.robust.verdict.answer import LEAD, SPEAKS_FOR_AMONG, ProbabilityModel
from regnf_core.robust.verdict.evidence import SPEAKS_FOR

Array = NDArray[np.float64]
LeftOut = Literal["world", "part", "eighth"]
LEFT_OUT: tuple[LeftOut, ...] = ("world", "part", "eighth")
CalibratedOn = Literal["all", "chosen"]
CALIBRATED_ON: tuple[CalibratedOn, ...] = ("all", "chosen")

PIECES = 5
"""Ramps for each feature, between its quantiles."""
PENALTY = 1e-3
"""Of the squared weights."""


MEASURED = {
    LOOK_ALIKE: "Look-alikes, which lack a part or have one more, some of them where the cameras did not see",
    SIMILAR: "The most similar ones of some dozens of other objects",
}
"""What rows are not trained with, by their model, and what tables call them."""
OF_OTHERS = 0.5
"""Weight of poses that no registration chose."""
BESIDE = 0.1
"""Weight of a pose of other scenes, which are trained with beside those that the model is for."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Poses with what is known of them: features (N, F), of the ``names`` · right (N,) 0 or 1 · weight (N,): of the
    pose in the training; 0: none · group (N,): the room or the part, by which poses belong together · calibrated (N,)
    bool: the poses that the probability is to be right of on average, of those that are trained with."""

    names: tuple[str, ...]
    features: Array
    right: Array
    weight: Array
    group: NDArray[Any]
    calibrated: NDArray[np.bool_]

    def __getitem__(self, index: Any) -> Evidence:
        rows = (self.features, self.right, self.weight, self.group, self.calibrated)
        return Evidence(self.names, *(one[index] for one in rows))

    def with_feature(self, name: str, values: Array, counts: NDArray[np.bool_]) -> Evidence:
        """The same with one more feature (N,), trained with where ``counts`` (N,)."""
        features = np.column_stack([self.features, values])
        return replace(self, names=(*self.names, name), features=features, weight=self.weight * counts)

    @property
    def signs(self) -> Array:
        """(F,) 1 where more of a feature speaks for a pose, else -1."""
        return np.array([1.0 if SPEAKS_FOR_AMONG[name] else -1.0 for name in self.names])

    @property
    def counted(self) -> Evidence:
        """The poses that are trained with."""
        return self[self.weight > 0.0]


@dataclass(frozen=True, eq=False)
class Ramps:
    """signs: (F,), see :class:`Evidence` · knots: (F, K) of each feature, turned so that more is better · weights:
    (F, K - 1) at least 0."""

    names: tuple[str, ...]
    signs: Array
    knots: Array
    weights: Array
    bias: float

    def logit(self, features: Array) -> Array:
        """(N,) log odds of rows (N, F)."""
        return self.bias + np.asarray(_design(features * self.signs, self.knots) @ self.weights.ravel())

    def scaled(self, slope: float, shift: float) -> Ramps:
        return replace(self, weights=slope * self.weights, bias=slope * self.bias + shift)

    def to_dict(self) -> dict[str, Any]:
        """As the model's file keeps it: features that do not count are left out."""
        terms = {}
        for name, knots, weights in zip(self.names, self.knots, self.weights, strict=True):
            if weights.sum() < 1e-3:
                continue
            values = np.concatenate([[-weights.sum()], np.cumsum(weights) - weights.sum()])
            if not SPEAKS_FOR_AMONG[name]:
                knots, values = -knots[::-1], values[::-1]
            terms[name] = {"knots": _rounded(knots), "values": _rounded(values)}
        return {"bias": round(self.bias, 4), "terms": terms}


@dataclass(frozen=True, eq=False)
class Trained:
    """model: as its file keeps it, by its name · table, diagram: how well the probabilities hold in worlds that were
    left out, Markdown and SVG."""

    model: dict[str, Any]
    table: str
    diagram: str


def trained(
    rows: Sequence[dict[str, Any]],
    left_out: LeftOut = "world",
    calibrated_on: CalibratedOn = "all",
    alone: ProbabilityModel | None = None,
    measured: Sequence[dict[str, Any]] = (),
    beside: Sequence[dict[str, Any]] = (),
) -> Trained:
    """A model from the rows of :mod:`benchmarks.worlds.evidence`.

    alone: the model of a pose alone, by which poses are chosen and lead: the one that is made knows a pose ``among``
    its candidates. None: it knows a pose ``alone`` · left_out: one world at a time, or a part with all of its meshes,
    which no other part has, or an eighth of the worlds · calibrated_on: the poses that the probabilities are to be
    right of on average, all or those that registrations chose · measured: further rows, which nothing is trained with;
    objects are compared in these · beside: rows of other scenes, which are trained with at a small weight, and neither
    calibrated on nor in the table. Of the features those count that all rows have: some rows are older than a feature.
    """
    own = len(rows)
    taught = np.arange(own + len(beside) + len(measured)) < own + len(beside)
    rows = [*rows, *beside, *measured]
    of_model = ~taught | (np.arange(len(rows)) < own)
    names = tuple(name for name in SPEAKS_FOR if all(name in row["features"] for row in rows))
    models, chosen = np.array([row["model"] for row in rows]), np.array([row["winner"] for row in rows])
    alike = np.isin(models, list(MEASURED))
    counts = np.array([not _told_apart_by_rivals(row) for row in rows]) & ~alike & taught
    evidence = Evidence(
        names,
        np.array([[row["features"][name] for name in names] for row in rows]),
        np.array([float(row["mssd"] <= SUCCESS) for row in rows]),
        np.where(chosen, 1.0, OF_OTHERS) * counts * np.where(of_model, 1.0, BESIDE),
        np.array([_group(row, left_out) for row in rows]),
        of_model & (chosen | (calibrated_on == "all")),
    )
    of_alone = None if alone is None else _odds(rows, alone)
    if of_alone is not None:
        found = np.array([row["found"] for row in rows])
        evidence = evidence.with_feature(LEAD, _leads(rows, of_alone), found)
    model, odds = train(evidence)
    shown = counts & of_model
    used = [row for row, one in zip(rows, shown, strict=True) if one]
    table = calibration_table(used, odds[shown])
    for asked, name in MEASURED.items():
        table += measured_line(name, [row for row in rows if row["model"] == asked], odds[models == asked])
        table += "" if of_alone is None else compared_line(asked, measured, of_alone[~taught])
    named = {"alone" if alone is None else "among": model.to_dict()}
    return Trained(named, table, reliability_diagram(used, odds[shown]))


def _odds(rows: Sequence[dict[str, Any]], model: ProbabilityModel) -> Array:
    """(N,) log odds that a model, made of other rows, gives each."""
    features = {term.feature: torch.tensor([row["features"][term.feature] for row in rows]) for term in model.terms}
    return np.asarray(model.logit(features))


def _group(row: dict[str, Any], left_out: LeftOut) -> str | int:
    seed = parts_of_name(row["world"])[1]
    return str(row["part"]) if left_out == "part" else seed % 8 if left_out == "eighth" else seed


def _leads(rows: Sequence[dict[str, Any]], odds: Array) -> Array:
    """(N,) as :func:`regnf_core.robust.verdict.answer.leads` has them, from each row's score and ``others``."""
    merits = odds - VERDICT.log_odds_per_score * np.array([row["score"] for row in rows])
    best = [max((merits[number + step] for step in row["others"]), default=-np.inf) for number, row in enumerate(rows)]
    return np.clip(merits - np.array(best), -VERDICT.most_lead, VERDICT.most_lead)


def _told_apart_by_rivals(row: dict[str, Any]) -> bool:
    """A wrong pose that is listed together with a right one: the verdict `ambiguous` says so, not the probability."""
    return bool(row["mssd"] > SUCCESS >= row["listed_mssd"])


def train(evidence: Evidence) -> tuple[Ramps, Array]:
    """The model, and the log odds (N,) that it gives each row when the row's group is left out."""
    left_out = np.zeros(len(evidence.right))
    for group in np.unique(evidence.group):
        of_group = evidence.group == group
        left_out[of_group] = _fit(evidence[~of_group].counted).logit(evidence.features[of_group])
    slope, shift = _platt(left_out[evidence.calibrated], evidence[evidence.calibrated])
    return _fit(evidence.counted).scaled(slope, shift), slope * left_out + shift


def _fit(evidence: Evidence) -> Ramps:
    turned = evidence.features * evidence.signs
    knots = np.stack([_knots(column) for column in turned.T])
    design = _design(turned, knots)
    start = np.zeros(design.shape[1] + 1)
    bounds = [(0.0, None)] * design.shape[1] + [(None, None)]
    found = minimize(_loss, start, (design, evidence), jac=True, bounds=bounds, method="L-BFGS-B")
    return Ramps(evidence.names, evidence.signs, knots, found.x[:-1].reshape(len(knots), -1), float(found.x[-1]))


def _loss(p: Array, design: Array, evidence: Evidence) -> tuple[float, Array]:
    """Weighted mean of the log loss, plus the penalty; and its gradient."""
    w = evidence.weight / evidence.weight.sum()
    z = design @ p[:-1] + p[-1]
    losses = np.logaddexp(0.0, np.where(evidence.right == 1, -z, z))
    off = w * (1.0 / (1.0 + np.exp(-z)) - evidence.right)
    value = float(w @ losses + PENALTY * p[:-1] @ p[:-1])
    return value, np.append(design.T @ off + 2 * PENALTY * p[:-1], off.sum())


def _platt(logits: Array, evidence: Evidence) -> tuple[float, float]:
    """Slope and shift that make the log odds right on average."""
    design = logits[:, None]

    def loss(p: Array) -> tuple[float, Array]:
        w = evidence.weight / evidence.weight.sum()
        z = design[:, 0] * p[0] + p[1]
        off = w * (1.0 / (1.0 + np.exp(-z)) - evidence.right)
        return float(w @ np.logaddexp(0.0, np.where(evidence.right == 1, -z, z))), np.array([off @ logits, off.sum()])

    found = minimize(loss, np.array([1.0, 0.0]), jac=True, method="L-BFGS-B")
    return float(found.x[0]), float(found.x[1])


def _knots(column: Array) -> Array:
    """PIECES + 1 increasing numbers: quantiles, moved apart where they coincide."""
    knots = np.quantile(column, np.linspace(0.02, 0.98, PIECES + 1))
    least = 1e-3 * max(float(np.ptp(column)), 1e-6)
    for i in range(1, len(knots)):
        knots[i] = max(knots[i], knots[i - 1] + least)
    return np.asarray(knots)


def _design(turned: Array, knots: Array) -> Array:
    """(N, F * PIECES): how far each row of features is short of the upper end of each piece, 0 to -1."""
    low, high = knots[:, :-1], knots[:, 1:]
    short = (high - turned[:, :, None]) / (high - low)
    return -np.clip(short, 0.0, 1.0).reshape(len(turned), -1)


def _rounded(values: Sequence[float] | Array) -> list[float]:
    return [round(float(value), 5) for value in values]
