"""The evaluation of refined pose candidates: the best one, its rivals, the verdict, metrics, covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.document import Alternative, Considered, ConsideredPose, Verdict
from regnf_core.geometry.metrics import distinct
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import Acceptance, RegistrationOptions, RobustOptions
from regnf_core.robust.constants import REFINEMENT, RELATION, VERDICT
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.loss import adaptive_width
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.residuals import residuals
from regnf_core.robust.verdict.answer import Answer, choose
from regnf_core.robust.verdict.comparison import Placed
from regnf_core.robust.verdict.covariance import covariance, in_object_units, with_common_errors, with_known_scale
from regnf_core.robust.verdict.evidence import HeldOut, gather_evidence, pose_features

# The verdict on an answer: one gate, its probability (`verdict/answer.py`), which holds all the evidence together. The
# option ``acceptance`` names the least one, or ``min_probability`` gives it. The reason of a rejection is the first
# share that is not usual. Beside the importer, a pose must stand within the detection: elsewhere, nothing was
# requested.


@dataclass(frozen=True)
class PoseVerdict:
    """A verdict and its reason (a stable UPPER_SNAKE word).

    broken: what a rejected pose lacks, in words with numbers; "" where the reason says it all · margin: by how much the
    probability is above its limit; negative for a rejected pose, -1 outside of the detection.
    """

    verdict: Verdict
    reason: str
    broken: str
    margin: float


LEVELS: dict[Acceptance, float] = {"default": VERDICT.default_probability, "strict": VERDICT.strict_probability}
"""The least probability of an answer by the name of its level."""


def least_probability(options: RobustOptions) -> float:
    """Of an accepted answer."""
    return LEVELS[options.acceptance] if options.min_probability is None else options.min_probability


def level_of(probability: float) -> Acceptance | None:
    """The strictest level that an answer of this probability reaches; None: none."""
    return max((name for name, least in LEVELS.items() if probability >= least), key=LEVELS.__getitem__, default=None)


@dataclass(frozen=True)
class _Usual:
    """A metric and its usual minimum or maximum for correct poses. name: in words."""

    reason: str
    name: str
    metric: str
    limit: float
    upper: bool = True

    def broken(self, told: dict[str, float]) -> str:
        """The violation, in words; "" if there is none."""
        value = told[self.metric]
        if (value <= self.limit) if self.upper else (value >= self.limit):
            return ""
        return f"{self.name} {value:.3g}, usually {self.limit:g} or {'less' if self.upper else 'more'}"


_USUAL = (
    _Usual("TOO_LITTLE_SURFACE", "hidden share", "hidden", VERDICT.usual_hidden),
    _Usual("FREE_SPACE_VIOLATED", "share in free space", "free_space_violations", VERDICT.usual_free),
    _Usual("LOW_OVERLAP", "object inliers", "inlier_share_object", VERDICT.usual_inliers, upper=False),
    _Usual("LOW_OVERLAP", "scene inliers", "inlier_share_scene", VERDICT.usual_inliers, upper=False),
    _Usual("SURFACE_UNEXPLAINED", "unexplained share", "unexplained_share_scene", VERDICT.usual_unexplained),
    _Usual("SCENE_UNEXPLAINED", "explained share", "explained_share_scene", VERDICT.usual_explained, upper=False),
)
"""Explanations of a rejection; the first violated one is used. The probability decides, these only explain a low
one."""


def evaluate_pose(
    held_out: HeldOut, index: int, rivals: int, options: RobustOptions, probability: float
) -> PoseVerdict:
    """The verdict on pose number ``index``, which has ``rivals`` alternatives.

    probability: that the pose or one of its alternatives is correct, 0..1. Written so that a number that is not finite
    can only lead to a rejection.
    """
    least = least_probability(options)
    margin = probability - least if math.isfinite(probability) else -1.0
    if not bool(held_out.admitted[index]):
        return PoseVerdict("rejected", "OUTSIDE_DETECTION", "", -1.0)
    if not margin >= 0.0:
        told = held_out.of(index) | {"hidden": float(held_out.features["hidden"][index])}
        return PoseVerdict("rejected", *_reason(told, probability, least), margin)
    if rivals:
        return PoseVerdict("ambiguous", "SEVERAL_POSES_AGREE", "", margin)
    return PoseVerdict("registered", "SURFACES_AGREE", "", margin)


def _reason(told: dict[str, float], probability: float, least: float) -> tuple[str, str]:
    """The reason of a low probability: the stable word and a sentence."""
    value, limit = f"{probability:.3g}", f"{least:.3g}"
    if value == limit:  # 0.6996 is not "0.7, at least 0.7"
        value, limit = str(probability), str(least)
    words = f"probability {value}, at least {limit} is required"
    for usual in _USUAL:
        if broken := usual.broken(told):
            return usual.reason, f"{words}; {broken}"
    return "LOW_PROBABILITY", words


# The candidate poses of a registration with the evidence for and against each, for display. It needs no further
# evaluations: the evidence is that of the verification samples, on which the verdict is based.

_MOST = 6


def considered_poses(
    problem: RegistrationProblem, candidates: PoseCandidates, held_out: HeldOut, answer: Answer, options: RobustOptions
) -> Considered:
    """The best distinct candidates, the most probable first."""
    points = problem.model.extremal_points
    ranked = distinct(candidates.T, answer.demerits, points, VERDICT.rivals_min_distance, len(candidates))
    chosen = ranked[:_MOST]
    poses = []
    for number in chosen.tolist():
        likely = float(answer.probability[number])
        found = evaluate_pose(held_out, number, 0, options, likely)
        T = problem.in_field_frames(candidates.T[number])
        metrics = {**held_out.of(number), "probability": likely}
        poses.append(ConsideredPose(T, found.reason, metrics, found.broken, level_of(likely)))
    scene = problem.view.frame.out_of(problem.held_out.scene_samples.points)
    obj = problem.model.frame.out_of(problem.held_out.object_samples.points)
    signs = held_out.evidence.scene_signs[chosen], held_out.evidence.object_signs[chosen]
    return Considered(poses, scene, obj, *signs)


# How one pose differs from another, in words: '180 degrees about z'.

_NEARLY = math.cos(math.radians(RELATION.axis_angle_deg))


def relation(T_other: Sim3, T_best: Sim3, free_axis: Tensor | None = None) -> str:
    """The turn of the object frame between two single poses; axes are the object frame's.

    free_axis: (3,), object frame, about which any turn would do as well.
    """
    difference = (T_other @ T_best.inverse()).log()
    omega, factor = difference[:3], math.exp(float(difference[6]))
    angle = float(omega.norm())
    words = []
    if angle > math.radians(RELATION.min_angle_deg):
        x, y, z = (omega / angle).tolist()
        degrees = round(math.degrees(angle))
        said = f"{degrees} degrees about ({x:.2f}, {y:.2f}, {z:.2f})"
        for name, value in zip("xyz", (x, y, z), strict=True):
            if abs(value) >= _NEARLY:
                said = f"{'-' if value < 0 and degrees != 180 else ''}{degrees} degrees about {name}"
        words.append(said)
        if free_axis is not None and abs(float(omega @ free_axis)) >= _NEARLY * angle:
            words.append("as any turn about this axis")
    if abs(factor - 1.0) > RELATION.min_scale_change:
        words.append(f"{factor:.2f} times the scale")
    return ", ".join(words) or "shifted"


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The best candidate by the held-out samples and what is known of it, on the CPU.

    held_out: of all candidates · winner: its number among the candidates · T: T_object_scene, in the fields' own frames
    · demerit: what the best candidates of several objects are compared by, as those of one object are.
    """

    found: PoseVerdict
    candidates: PoseCandidates
    held_out: HeldOut
    winner: int
    T: Sim3
    metrics: dict[str, float]
    alternatives: list[Alternative]
    considered: Considered
    demerit: float

    @property
    def doubtful(self) -> bool:
        """Whether a further attempt is worth its time: it may find a better pose, or one that speaks against this."""
        return self.found.verdict == "rejected" or self.metrics["probability"] < VERDICT.doubtful

    def placed(self, problem: RegistrationProblem) -> Placed:
        """The best candidate, for comparing it with another object's."""
        assert self.candidates.offsets is not None, "candidates refined on the fields have offsets"
        one = torch.tensor([self.winner])
        return Placed(problem, self.candidates.T[self.winner], self.candidates.offsets[one])

    @property
    def rank(self) -> tuple[bool, float]:
        """Smaller is better: rejections last, then the larger demerit."""
        return self.found.verdict == "rejected", self.demerit


def evaluate_candidates(
    problem: RegistrationProblem, candidates: PoseCandidates, options: RegistrationOptions, known: HeldOut | None = None
) -> Evaluation:
    """Choose the most probable candidate by the held-out samples, and decide on its verdict. Needs surface offsets.

    known: what they told before of the first of the candidates. The fields are evaluated on the problem's device; what
    follows is decided on the CPU.
    """
    first = 0 if known is None else len(known.admitted)
    asked = held_out_of(problem, candidates[first:], options)
    held_out = asked if known is None else HeldOut.cat([known, asked])
    problem, candidates = problem.on("cpu"), candidates.on("cpu")
    scores = held_out.evidence.numbers["score"]
    answer = choose(problem, candidates, held_out.features, scores, options.robust.rival_margin)
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
        "iterations": float(0 if candidates.history is None else len(candidates.history.widths)),
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
    evidence = gather_evidence(r, offsets, options.robust).on("cpu")
    features = {name: one.cpu() for name, one in pose_features(problem, T, r, offsets).items()}
    problem.held_out.require_finite()
    return HeldOut(evidence, features, problem.bound.on("cpu").admits(T.on("cpu")))


def _alternatives(
    problem: RegistrationProblem, candidates: PoseCandidates, answer: Answer, T_best: Sim3
) -> list[Alternative]:
    axis = problem.model.symmetry.axis
    poses = [(number, problem.in_field_frames(candidates.T[number])) for number in answer.rivals]
    return [Alternative(T, float(answer.scores[number]), relation(T, T_best, axis)) for number, T in poses]


def pose_covariance(problem: RegistrationProblem, evaluation: Evaluation) -> Tensor:
    """(7, 7) of the best pose, in object units: see :mod:`regnf_core.robust.verdict.covariance`."""
    candidates, best = evaluation.candidates, torch.tensor([evaluation.winner])
    T, device = candidates.T[evaluation.winner], problem.fit.scene_samples.points.device
    offset = None if candidates.offsets is None or problem.view.max_offset == 0.0 else candidates.offsets[best]
    r = residuals(problem.fit, candidates.T[best].on(device), None if offset is None else offset.to(device)).on("cpu")
    fit = problem.fit.on("cpu")
    A, B = fit.scene_samples, fit.object_samples
    places = torch.cat([T.apply(A.points.double()), B.points.double()])
    last = REFINEMENT.last_stages[-1]
    cov = covariance(r, adaptive_width(r, last.widths[-1], last.widest), places)
    cov = with_common_errors(cov, B.points, T, 0.0 if r.offset is None else float(r.offset))
    cov = with_known_scale(cov, problem.bound.scale.log_width)
    return in_object_units(cov, T, problem.view.frame, problem.model.frame)
