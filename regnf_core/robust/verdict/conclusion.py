"""What is to be said of the finalists: the winner, its rivals, the verdict and the covariance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.pose_distance import distinct
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.result import Alternative, Verdict
from regnf_core.robust.pipeline import Outcome, Problem
from regnf_core.robust.refine.levenberg_marquardt import fitting_width
from regnf_core.robust.refine.pose_candidates import LAST
from regnf_core.robust.residuals import residuals
from regnf_core.robust.verdict.covariance import covariance, in_object_units
from regnf_core.robust.verdict.judgment import decide
from regnf_core.robust.verdict.relation import relation
from regnf_core.robust.verdict.unexplained_surface import extra_share

_RIVALS_APART = 0.1  # object diameters: poses closer together are one answer with its uncertainty
_MARGIN_PER_SCORE = 0.15  # the worse the fields agree at all, the less a difference says


@dataclass(frozen=True)
class Conclusion:
    """The winner by the held-out samples, and all that is to be said of it. winner: its number among the finalists."""

    verdict: Verdict
    reason: str
    winner: int
    T_work: Sim3
    T: Sim3
    metrics: dict[str, float]
    alternatives: list[Alternative]

    @property
    def rank(self) -> tuple[bool, float]:
        """The smaller, the better: rejections last, among the others what agrees less."""
        return self.verdict == "rejected", self.metrics["score"]


def conclude(problem: Problem, outcome: Outcome, options: RegistrationOptions) -> Conclusion:
    """The winner by the held-out samples, its rivals, verdict and covariance."""
    evidence, poses = outcome.evidence, outcome.finalists.T
    winner = int(evidence.scores.argmin())
    ranked = distinct(poses, evidence.scores, problem.model.extremes, _RIVALS_APART, poses.scale.numel())
    best = float(evidence.scores[winner])
    close = evidence.scores <= best + options.robust.rival_margin + _MARGIN_PER_SCORE * best
    rivals = [i for i in ranked.tolist() if i != winner and close[i]]
    T_work = poses[winner]
    extra = extra_share(
        problem.scene_field, problem.object_field, problem.A_held, T_work, evidence.offsets[winner], options.robust
    )
    decision = decide(evidence, winner, len(rivals), options.robust, problem.view.incoherence, extra)
    T = problem.in_field_frames(T_work)
    alternatives = []
    axis = problem.model.symmetry.axis
    for i in rivals if decision.verdict != "rejected" else []:
        other = problem.in_field_frames(poses[i])
        alternatives.append(Alternative(other, float(evidence.scores[i]), relation(other, T, axis)))
    diameter = problem.model.frame.length
    metrics = {
        **evidence.of(winner),
        "extra_share_scene": extra,
        "verdict_margin": decision.margin,
        "object_diameter": diameter,
        "shadow_share_scene": problem.view.shadow_share,
        "iterations": float(len(outcome.finalists.trail.steps)),
        "finalists": float(evidence.scores.numel()),
    }
    return Conclusion(decision.verdict, decision.reason, winner, T_work, T, metrics, alternatives)


def pose_covariance(problem: Problem, T_work: Sim3, offset: Tensor) -> Tensor:
    """(7, 7) of a pose between the working frames, in object units: see :mod:`regnf_core.robust.verdict.covariance`.

    offset: of the surfaces, object diameters, a single number.
    """
    A, B = problem.A, problem.B
    offsets = offset[None] if problem.view.most_offset > 0.0 else None
    r = residuals(problem.scene_field, problem.object_field, A, B, T_work[None], offsets)
    places = torch.cat([T_work.apply(A.points.double()), B.points.double()])
    cov = covariance(r, fitting_width(r, LAST.widths[-1]), places)
    return in_object_units(cov, T_work, problem.view.frame, problem.model.frame)
