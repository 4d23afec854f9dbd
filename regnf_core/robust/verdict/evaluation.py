"""The evaluation of refined pose candidates: the best one, its rivals, the verdict, metrics, covariance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.result import Alternative, Considered, Verdict
from regnf_core.robust.constants import REFINEMENT, VERDICT
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.loss import adaptive_width
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.residuals import residuals
from regnf_core.robust.verdict.answer import Answer, choose
from regnf_core.robust.verdict.considered import considered_poses
from regnf_core.robust.verdict.covariance import covariance, in_object_units, with_common_errors, with_known_scale
from regnf_core.robust.verdict.criteria import PoseVerdict, evaluate_pose
from regnf_core.robust.verdict.evidence import HeldOut, gather_evidence
from regnf_core.robust.verdict.pose_features import pose_features
from regnf_core.robust.verdict.relation import relation


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The best candidate by the held-out samples and what is known of it, on the CPU. winner: its number among the
    candidates."""

    found: PoseVerdict
    candidates: PoseCandidates
    held_out: HeldOut
    """Of all candidates."""
    winner: int
    T: Sim3
    """T_object_scene, in the fields' own frames."""
    metrics: dict[str, float]
    alternatives: list[Alternative]
    considered: Considered

    demerit: float
    """What the best candidates of several objects are compared by, as those of one object are."""

    @property
    def verdict(self) -> Verdict:
        return self.found.verdict

    @property
    def reason(self) -> str:
        return self.found.reason

    @property
    def doubtful(self) -> bool:
        """Whether a further attempt is worth its time: it may find a better pose, or one that speaks against this."""
        return self.verdict == "rejected" or self.metrics["probability"] < VERDICT.doubtful

    @property
    def rank(self) -> tuple[bool, float]:
        """Smaller is better: rejections last, then the larger demerit."""
        return self.verdict == "rejected", self.demerit


def evaluate_candidates(
    problem: RegistrationProblem,
    candidates: PoseCandidates,
    options: RegistrationOptions,
    known: HeldOut | None = None,
) -> Evaluation:
    """Choose the likeliest candidate by the held-out samples, and decide on its verdict. Needs surface offsets.

    known: what they told before of the first of the candidates. The fields are evaluated on the problem's device; what
    follows is decided on the CPU.
    """
    first = 0 if known is None else len(known.admitted)
    asked = held_out_of(problem, candidates[first:], options)
    held_out = asked if known is None else HeldOut.cat([known, asked])
    problem, candidates = problem.to("cpu"), candidates.to("cpu")
    answer = choose(problem, candidates, held_out.features, held_out.evidence.scores, options.robust.rival_margin)
    winner, likely = answer.winner, float(answer.probability[answer.winner])
    found = evaluate_pose(held_out, winner, len(answer.rivals), options.robust, likely)
    T = problem.in_field_frames(candidates.T[winner])
    metrics = {
        **held_out.of(winner),
        "probability": likely,
        "probability_alone": float(answer.probability_alone[winner]),
        "verdict_margin": found.margin,
        "object_diameter": problem.model.frame.length,
        "occlusion_boundary_share_scene": problem.view.occlusion_boundary_share,
        "iterations": float(len(candidates.history)),
        "pose_candidates": float(len(candidates)),
    }
    return Evaluation(
        found,
        candidates,
        held_out,
        winner,
        T,
        metrics,
        alternatives=[] if found.verdict == "rejected" else _alternatives(problem, candidates, answer, T),
        considered=considered_poses(problem, candidates, held_out, answer, options.robust),
        demerit=float(answer.demerits[winner]),
    )


def held_out_of(problem: RegistrationProblem, candidates: PoseCandidates, options: RegistrationOptions) -> HeldOut:
    """What the held-out samples tell of the candidates: the fields are evaluated once for all of it, where the problem
    is. Raises InvalidInputError (FIELD_NOT_FINITE)."""
    assert candidates.offsets is not None, "candidates refined on the fields have offsets"
    T, offsets = candidates.T, candidates.offsets
    r = residuals(problem.held_out, T, offsets)
    evidence = gather_evidence(r, offsets, options.robust).to("cpu")
    features = {name: one.cpu() for name, one in pose_features(problem, T, r, offsets).items()}
    problem.held_out.require_finite()
    return HeldOut(evidence, features, problem.bound.to("cpu").admits(T.on("cpu")))


def _alternatives(
    problem: RegistrationProblem, candidates: PoseCandidates, answer: Answer, T_best: Sim3
) -> list[Alternative]:
    axis = problem.model.symmetry.axis
    alternatives = []
    for number in answer.rivals:
        T = problem.in_field_frames(candidates.T[number])
        alternatives.append(Alternative(T, float(answer.scores[number]), relation(T, T_best, axis)))
    return alternatives


def pose_covariance(problem: RegistrationProblem, evaluation: Evaluation) -> Tensor:
    """(7, 7) of the best pose, in object units: see :mod:`regnf_core.robust.verdict.covariance`."""
    candidates, best = evaluation.candidates, torch.tensor([evaluation.winner])
    T, device = candidates.T[evaluation.winner], problem.fit.scene_samples.points.device
    offset = None if candidates.offsets is None or problem.view.max_offset == 0.0 else candidates.offsets[best]
    r = residuals(problem.fit, candidates.T[best].on(device), None if offset is None else offset.to(device)).to("cpu")
    fit = problem.fit.to("cpu")
    A, B = fit.scene_samples, fit.object_samples
    places = torch.cat([T.apply(A.points.double()), B.points.double()])
    last = REFINEMENT.last_stages[-1]
    cov = covariance(r, adaptive_width(r, last.widths[-1], last.widest), places)
    cov = with_common_errors(cov, B.points, T, 0.0 if r.offset is None else float(r.offset))
    cov = with_known_scale(cov, problem.bound.scale.log_width)
    return in_object_units(cov, T, problem.view.frame, problem.model.frame)
