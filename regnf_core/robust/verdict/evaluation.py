"""The evaluation of refined pose candidates: the best one, its rivals, the verdict, metrics, covariance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.pose_distance import distinct
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.result import Alternative, Verdict
from regnf_core.robust.constants import REFINEMENT, VERDICT
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.loss import adaptive_width
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.residuals import residuals
from regnf_core.robust.verdict.covariance import covariance, in_object_units
from regnf_core.robust.verdict.criteria import PoseVerdict, SceneQuality, evaluate_pose
from regnf_core.robust.verdict.evidence import Evidence, gather_evidence
from regnf_core.robust.verdict.pose_features import pose_features
from regnf_core.robust.verdict.probability import probability_model
from regnf_core.robust.verdict.relation import relation


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The best candidate by the held-out samples and what is known of it. winner: its number among the candidates."""

    verdict: Verdict
    reason: str
    candidates: PoseCandidates
    winner: int
    T: Sim3
    """T_object_scene, in the fields' own frames."""
    metrics: dict[str, float]
    alternatives: list[Alternative]

    @property
    def rank(self) -> tuple[bool, float]:
        """Smaller is better: rejections last, then by the score."""
        return self.verdict == "rejected", self.metrics["score"]


def evaluate_candidates(
    problem: RegistrationProblem, candidates: PoseCandidates, options: RegistrationOptions
) -> Evaluation:
    """Choose the best candidate by the held-out samples, and decide on its verdict. Needs surface offsets."""
    assert candidates.offsets is not None, "candidates refined on the fields have offsets"
    evidence = gather_evidence(problem.held_out, candidates.T, candidates.offsets, options.robust)
    winner = int(evidence.scores.argmin())
    rivals = rival_numbers(problem, candidates, evidence, options.robust.rival_margin)
    found, metrics = _verdict(problem, candidates[torch.tensor([winner])], evidence, (winner, len(rivals)), options)
    T = problem.in_field_frames(candidates.T[winner])
    alternatives = [] if found.verdict == "rejected" else _alternatives(problem, candidates, evidence, rivals, T)
    metrics = {
        **evidence.of(winner),
        **metrics,
        "verdict_margin": found.margin,
        "object_diameter": problem.model.frame.length,
        "occlusion_boundary_share_scene": problem.view.occlusion_boundary_share,
        "iterations": float(len(candidates.history)),
        "pose_candidates": float(len(candidates)),
    }
    return Evaluation(found.verdict, found.reason, candidates, winner, T, metrics, alternatives)


def _verdict(
    problem: RegistrationProblem,
    best: PoseCandidates,
    evidence: Evidence,
    numbers: tuple[int, int],
    options: RegistrationOptions,
) -> tuple[PoseVerdict, dict[str, float]]:
    """The verdict on the best pose (1,), and what else it rests on. numbers: of the pose in the evidence, of rivals."""
    assert best.offsets is not None
    features = pose_features(problem, best.T, best.offsets)
    unexplained = float(features["unexplained"][0])
    winner, rivals = numbers
    quality = SceneQuality(problem.view.normal_roughness, unexplained)
    probability = float(probability_model().logit(features).sigmoid()[0])
    found = evaluate_pose(evidence, winner, rivals, options.robust, quality, probability)
    if not bool(problem.bound.admits(best.T)[0]):
        found = PoseVerdict("rejected", "OUTSIDE_DETECTION", min(found.margin, -1.0))
    return found, {"probability": probability, "unexplained_share_scene": unexplained}


def rival_numbers(
    problem: RegistrationProblem, candidates: PoseCandidates, evidence: Evidence, rival_margin: float
) -> list[int]:
    """Numbers of the other poses that explain the held-out samples as well as the best one, best first."""
    best = float(evidence.scores.min())
    close = evidence.scores <= best + rival_margin + VERDICT.rival_margin_per_score * best
    points = problem.model.extremal_points
    ranked = distinct(candidates.T, evidence.scores, points, VERDICT.rivals_min_distance, len(candidates))
    winner = int(evidence.scores.argmin())
    return [number for number in ranked.tolist() if number != winner and close[number]]


def _alternatives(
    problem: RegistrationProblem, candidates: PoseCandidates, evidence: Evidence, rivals: list[int], T_best: Sim3
) -> list[Alternative]:
    axis = problem.model.symmetry.axis
    alternatives = []
    for number in rivals:
        T = problem.in_field_frames(candidates.T[number])
        alternatives.append(Alternative(T, float(evidence.scores[number]), relation(T, T_best, axis)))
    return alternatives


def pose_covariance(problem: RegistrationProblem, evaluation: Evaluation) -> Tensor:
    """(7, 7) of the best pose, in object units: see :mod:`regnf_core.robust.verdict.covariance`."""
    candidates, best = evaluation.candidates, torch.tensor([evaluation.winner])
    T = candidates.T[evaluation.winner]
    offset = None if candidates.offsets is None or problem.view.max_offset == 0.0 else candidates.offsets[best]
    r = residuals(problem.fit, candidates.T[best], offset)
    A, B = problem.fit.scene_samples, problem.fit.object_samples
    places = torch.cat([T.apply(A.points.double()), B.points.double()])
    cov = covariance(r, adaptive_width(r, REFINEMENT.last_stage.widths[-1]), places)
    return in_object_units(cov, T, problem.view.frame, problem.model.frame)
