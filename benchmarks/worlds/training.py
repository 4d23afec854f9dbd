"""The probability models of the verdict, trained on evidence from random worlds: ``python -m benchmarks.worlds train``.

Logistic regression on monotone ramps: each feature's range is cut at quantiles, and each piece has a ramp whose weight
is at least 0, so the sum is monotone in every feature. Eighths of the worlds are left out in turn to see what the model
says of rooms that it does not know; what it says of them is then made right on average (Platt's scaling).

First a model of a pose alone is made, of all rows. It chooses the answers, as the engine does, and tells by how much
they lead. Then a model of answers is made for each kind of scene. Wrong objects are learned from like wrong poses,
but for those whose difference nobody saw: how probable they are is a matter of how many of them are asked for.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from benchmarks.robust.judging import SUCCESS
from benchmarks.worlds.recipe import parts_of_name
from benchmarks.worlds.trust import Row, cannot_be_told
from regnf_core.options import RobustOptions
from regnf_core.robust.constants import VERDICT
from regnf_core.robust.verdict.answer import (
    LEAD,
    SPEAKS_FOR_AMONG,
    Answer,
    PoseOdds,
    ProbabilityModel,
    Relations,
    answer_of,
    apart_from_answer,
    leads,
)
from regnf_core.robust.verdict.evidence import SPEAKS_FOR

Array = NDArray[np.float64]
PIECES = 5
"""Ramps for each feature, between its quantiles."""
PENALTY = 1e-3
"""Of the squared weights."""
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
            if weights.sum() < 1e-3 or (np.diff(_rounded(knots)) <= 0.0).any():  # or it is the same in all rows
                continue
            values = np.concatenate([[-weights.sum()], np.cumsum(weights) - weights.sum()])
            if not SPEAKS_FOR_AMONG[name]:
                knots, values = -knots[::-1], values[::-1]
            terms[name] = {"knots": _rounded(knots), "values": _rounded(values)}
        return {"bias": round(self.bias, 4), "terms": terms}


@dataclass(frozen=True, eq=False)
class Trained:
    """models: of a pose alone and of answers among their candidates, by kind of scene, as the file keeps them ·
    answers: the rows of the answers that these models choose, each with the probability of a model that has not learned
    from its world."""

    models: dict[str, Any]
    answers: list[Row]


def trained(rows: Sequence[Row], prior: dict[str, ProbabilityModel] | None = None) -> Trained:
    """All models from the rows of :mod:`benchmarks.worlds.evidence`. prior: the models of before, by name: what is
    learned is how these rows differ from them; a kind of scene without rows keeps its model."""
    prior = prior or {}
    rows = [row for row in rows if row["features"]]
    groups = np.array([_eighth(row) for row in rows])
    told = _told(rows)
    # Of a feature that rows are older than nothing is learned: it stays as the prior has it.
    features = np.array([[row["features"].get(name, 0.0) for name in SPEAKS_FOR] for row in rows])
    right = np.array([float(row["mssd"] <= SUCCESS) for row in rows])
    weight = np.where([row["winner"] for row in rows], 1.0, OF_OTHERS) * told * _balance(rows)
    everything = np.ones(len(rows), dtype=bool)
    evidence = Evidence(tuple(SPEAKS_FOR), features, right, weight, groups, everything)
    models: dict[str, Any] = {"alone": train(evidence, prior.get("alone"))[0].to_dict()}
    chosen = _answers(rows, ProbabilityModel.from_dict(models["alone"]))
    kinds = np.array([_model_of(row) for row in rows])
    answers: list[Row] = []
    told_of = {_key(row): row for row in rows if row["winner"] and row["found"]}  # of the engine's own answers
    for kind in sorted(set(kinds[chosen.found])):
        of_kind = kinds == kind
        beside = (kinds == "observed") & (kind == "thing")
        weight = np.where(chosen.winner, 1.0, OF_OTHERS) * told * chosen.found * _balance(rows)
        weight *= np.where(of_kind, 1.0, np.where(beside, BESIDE, 0.0))
        among = Evidence(tuple(SPEAKS_FOR), features, chosen.right, weight, groups, of_kind & chosen.winner)
        among = among.with_feature(LEAD, chosen.leads, np.ones(len(rows)))
        model, odds = train(among, prior.get(kind))
        models[kind] = model.to_dict()
        for number in np.flatnonzero(of_kind & chosen.winner):
            said = {"probability": float(1.0 / (1.0 + np.exp(-odds[number]))), "winner": True}
            answers.append(
                {**told_of[_key(rows[number])], **rows[number], **said, "listed_mssd": float(chosen.listed[number])}
            )
    return Trained(models, answers)


def _balance(rows: Sequence[Row]) -> Array:
    """(N,): weights by which there are as many wrong questions as right ones, however many were asked."""
    right = np.array([row["question"] == "right" for row in rows])
    answers = np.array([row["winner"] and row["found"] for row in rows])
    wrong = max(int((answers & ~right).sum()), 1)
    return np.where(right, 1.0, max(int((answers & right).sum()), 1) / wrong)


def _model_of(row: Row) -> str:
    """The name of the model that a row is for."""
    if row["scene"] == "frames":
        return "thing"
    return "observed" if row["observed"] else "unobserved"


def _eighth(row: Row) -> int:
    """What is left out together: an eighth of the worlds, with all that was asked in each."""
    return parts_of_name(row["world"])[1] % 8


def _told(rows: Sequence[Row]) -> NDArray[np.bool_]:
    """(N,): whether a row can be learned from: not those of a wrong object that was not seen to differ."""
    hidden = {_key(row) for row in rows if row["winner"] and row["found"] and cannot_be_told(row)}
    return np.array([_key(row) not in hidden for row in rows])


def _key(row: Row) -> tuple[Any, ...]:
    """Of a registration."""
    return tuple(row.get(name) for name in ("world", "case", "question", "observed_by", "seed"))


@dataclass(frozen=True, eq=False)
class _Answers:
    """What a model of poses alone chooses, for rows (N,): which are candidates, which of them are answers, whether they
    are right (answers by what they list), their leads, and the least errors of what they list."""

    found: NDArray[np.bool_]
    winner: NDArray[np.bool_]
    right: Array
    leads: Array
    listed: Array


def _answers(rows: Sequence[Row], alone: ProbabilityModel) -> _Answers:
    found = np.array([row["found"] for row in rows])
    winner, leads_of = np.zeros(len(rows), dtype=bool), np.zeros(len(rows))
    listed = np.array([row["mssd"] for row in rows])
    candidates = np.flatnonzero(found).tolist()
    for _, group in itertools.groupby(candidates, key=lambda number: _key(rows[number])):
        numbers = list(group)
        some = [rows[number] for number in numbers]
        answer, lead = answer_in(some, alone)
        winner[numbers[answer.winner]] = True
        leads_of[numbers] = lead
        listed[numbers[answer.winner]] = min(some[one]["mssd"] for one in (answer.winner, *answer.rivals))
    return _Answers(found, winner, (listed <= SUCCESS).astype(float), leads_of, listed)


def answer_in(candidates: Sequence[Row], alone: ProbabilityModel) -> tuple[Answer, Array]:
    """The answer that the engine would give among these candidates with another model, and the leads (H,) of all."""
    count = len(candidates)
    apart = torch.zeros(count, count, dtype=torch.bool)
    for number, row in enumerate(candidates):
        apart[number, [number + step for step in row["others"]]] = True
    moved = torch.tensor([row["moved"] for row in candidates])
    same = [row["same"] for row in candidates]
    poses = Relations(moved, apart, lambda one, other: same[one][other])
    features = {
        name: torch.tensor([row["features"].get(name, 0.0) for row in candidates]).double() for name in SPEAKS_FOR
    }
    scores = torch.tensor([row["score"] for row in candidates]).double()
    margin = RobustOptions().rival_margin
    answer = answer_of(PoseOdds(alone, alone), features, scores, poses, margin)
    alike = [one for one in answer.rivals if same[one][answer.winner] >= VERDICT.min_same_surface]
    joined = apart_from_answer(apart, [answer.winner, *alike])
    return answer, leads(-answer.demerits, joined).numpy()


def train(evidence: Evidence, prior: ProbabilityModel | None = None) -> tuple[Ramps, Array]:
    """The model, and the log odds (N,) that it gives each row when the row's group is left out.

    prior: what an earlier model has learned from other rows; what these rows do not tell stays as it has it.
    """
    left_out = np.zeros(len(evidence.right))
    for group in np.unique(evidence.group):
        of_group = evidence.group == group
        left_out[of_group] = _fit(evidence[~of_group].counted, prior).logit(evidence.features[of_group])
    slope, shift = _platt(left_out[evidence.calibrated], evidence[evidence.calibrated])
    return _fit(evidence.counted, prior).scaled(slope, shift), slope * left_out + shift


def _fit(evidence: Evidence, prior: ProbabilityModel | None) -> Ramps:
    turned = evidence.features * evidence.signs
    known = {} if prior is None else {term.feature: term for term in prior.terms}
    knots, expected = [], []
    for name, sign, column in zip(evidence.names, evidence.signs, turned.T, strict=True):
        if name in known:
            places, values = known[name].knots.numpy(), known[name].values.numpy()
            if sign < 0:
                places, values = -places[::-1], values[::-1]
            knots.append(places)
            expected.append(np.diff(values))
        else:
            knots.append(_knots(column))
            expected.append(np.zeros(PIECES))
    design = _design(turned, np.stack(knots))
    start = np.append(np.concatenate(expected), 0.0 if prior is None else prior.bias)
    bounds = [(0.0, None)] * design.shape[1] + [(None, None)]
    found = minimize(_loss, start, (design, evidence, start[:-1]), jac=True, bounds=bounds, method="L-BFGS-B")
    weights = found.x[:-1].reshape(len(knots), -1)
    return Ramps(evidence.names, evidence.signs, np.stack(knots), weights, float(found.x[-1]))


def _loss(p: Array, design: Array, evidence: Evidence, expected: Array) -> tuple[float, Array]:
    """Weighted mean of the log loss, plus the penalty on what differs from the ``expected`` weights; its gradient."""
    w = evidence.weight / evidence.weight.sum()
    z = design @ p[:-1] + p[-1]
    losses = np.logaddexp(0.0, np.where(evidence.right == 1, -z, z))
    off = w * (1.0 / (1.0 + np.exp(-z)) - evidence.right)
    change = p[:-1] - expected
    value = float(w @ losses + PENALTY * change @ change)
    return value, np.append(design.T @ off + 2 * PENALTY * change, off.sum())


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
