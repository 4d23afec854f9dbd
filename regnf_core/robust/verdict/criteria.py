"""The criteria of the verdict, on held-out samples, and the margin by which they were met.

Where the scene's field is rough, the right object does not reach the inlier distance of accurate fields, and normals
tell little. There, coarse agreement may stand in: the samples that agree at twice the distance, whatever the normals,
minus the share of the object that lies in free space by more than that. Another object's shape differs by more than the
roughness. The thresholds are VERDICT in regnf_core/robust/constants/verdict.py and the options of the preset.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from regnf_core.options import RobustOptions
from regnf_core.result import Verdict
from regnf_core.robust.constants import VERDICT
from regnf_core.robust.verdict.evidence import Evidence


@dataclass(frozen=True)
class SceneQuality:
    """Of the scene near one pose. normal_roughness: of its surface, see :mod:`regnf_core.robust.scene.smoothing` ·
    unexplained: share of the surface near the object that is no part of it, see
    :mod:`regnf_core.robust.verdict.unexplained_surface` · hidden: share of the object that is occluded or was not
    observed, wherever it lies."""

    normal_roughness: float = 0.0
    unexplained: float = 0.0
    hidden: float = 0.0


@dataclass(frozen=True)
class PoseVerdict:
    """A verdict, its reason (a stable UPPER_SNAKE word), and by what share 0..1 the narrowest of its criteria was met;
    negative where it was missed, that is, where the pose is rejected."""

    verdict: Verdict
    reason: str
    margin: float


@dataclass(frozen=True)
class _Criterion:
    """slack: by how much it is met, negative where it is not."""

    reason: str
    slack: float

    @property
    def met(self) -> bool:
        """False for a slack that is not a number."""
        return self.slack >= 0.0


_UNKNOWN_QUALITY = SceneQuality()


def evaluate_pose(
    evidence: Evidence,
    index: int,
    rivals: int,
    options: RobustOptions,
    quality: SceneQuality = _UNKNOWN_QUALITY,
    probability: float | None = None,
) -> PoseVerdict:
    """The verdict on pose number ``index`` of the evidence, which ``rivals`` other poses equal.

    probability: that the pose or one of its rivals is right, 0..1, by all the evidence together. Where it is high, it
    stands in for the agreement of the surfaces; where it is low, the pose is rejected although all criteria are met.
    Written so that a number that is not finite can only lead to a rejection.
    """
    occluded = _Criterion("TOO_LITTLE_SURFACE", options.max_occluded_share - float(evidence.occluded[index]))
    hidden = _Criterion("TOO_LITTLE_SURFACE", VERDICT.max_hidden - quality.hidden)
    accurate = list(_of_accurate_fields(evidence, index, options))
    unexplained = _unexplained(evidence, index, quality.unexplained)
    rough = _smallest_slack(_of_rough_fields(evidence, index, options, quality.normal_roughness))
    observed = _smallest_slack(_of_observed_surface(evidence, index, options))
    likely = -1.0 if probability is None else probability - options.min_probability
    agreement = max(_smallest_slack(accurate), rough, observed, likely)
    margin = min(_smallest_slack([occluded, hidden, unexplained]), agreement)
    if not margin >= 0.0:
        relevant = [occluded, hidden, unexplained]
        if not agreement >= 0.0:
            relevant = [occluded, hidden, accurate[0], unexplained, *accurate[1:]]
        return PoseVerdict("rejected", next(one.reason for one in relevant if not one.met), margin)
    if probability is not None and not probability >= VERDICT.min_probability:
        return PoseVerdict("rejected", "LOW_PROBABILITY", probability - VERDICT.min_probability)
    if rivals:
        return PoseVerdict("ambiguous", "SEVERAL_POSES_AGREE", margin)
    return PoseVerdict("registered", "SURFACES_AGREE", margin)


def _smallest_slack(criteria: Iterable[_Criterion]) -> float:
    """-1 where a slack is not a number, and where there are no criteria."""
    return min((-1.0 if math.isnan(one.slack) else one.slack for one in criteria), default=-1.0)


def _of_accurate_fields(evidence: Evidence, index: int, options: RobustOptions) -> Iterable[_Criterion]:
    noise = float(evidence.residual_rms[index])
    violations = VERDICT.clean_violations + VERDICT.violations_per_noise * noise
    violations = min(options.max_free_space_violations, violations)
    of_scene = VERDICT.clean_inlier_share - VERDICT.inlier_share_per_noise * noise
    of_scene = max(options.min_inlier_share, of_scene)
    yield _Criterion("FREE_SPACE_VIOLATED", violations - float(evidence.violations[index]))
    yield _Criterion("LOW_OVERLAP", float(evidence.share_object[index]) - options.min_inlier_share)
    yield _Criterion("LOW_OVERLAP", float(evidence.share_scene[index]) - of_scene)
    yield _Criterion("SCENE_UNEXPLAINED", float(evidence.share_explained[index]) - options.min_explained_share)


def _of_rough_fields(
    evidence: Evidence, index: int, options: RobustOptions, normal_roughness: float
) -> Iterable[_Criterion]:
    """Whether the fields disagree no more than fields of such roughness do at the right pose."""
    if not normal_roughness >= VERDICT.rough:
        return
    score = VERDICT.rough_score + VERDICT.score_per_normal_roughness * (normal_roughness - VERDICT.rough)
    yield _Criterion("LOW_OVERLAP", score - float(evidence.scores[index]))
    yield _Criterion("LOW_OVERLAP", 1.0 - float(evidence.tail_ratio[index]) / VERDICT.max_tail_ratio)
    min_coarse = VERDICT.min_coarse_partial if evidence.partial else VERDICT.min_coarse
    yield _Criterion("LOW_OVERLAP", float(evidence.coarse[index]) - min_coarse)
    if evidence.partial:
        yield _Criterion("TOO_LITTLE_SURFACE", VERDICT.max_occluded - float(evidence.occluded[index]))
    yield _Criterion("SCENE_UNEXPLAINED", float(evidence.explained_coarsely[index]) - options.min_explained_share)


def _of_observed_surface(evidence: Evidence, index: int, options: RobustOptions) -> Iterable[_Criterion]:
    """Whether both shapes agree at twice the distance, however smooth the field, where unobserved surface is left out:
    on enough of the object, and without an offset that makes one object look like another."""
    if not evidence.partial:
        return
    yield _Criterion("TOO_LITTLE_SURFACE", VERDICT.max_occluded - float(evidence.occluded[index]))
    yield _Criterion("LOW_OVERLAP", 1.0 - float(evidence.tail_ratio[index]) / VERDICT.max_tail_ratio)
    yield _Criterion("LOW_OVERLAP", float(evidence.coarse[index]) - VERDICT.min_coarse_observed)
    yield _Criterion("LOW_OVERLAP", VERDICT.max_offset - abs(float(evidence.offsets[index])))
    yield _Criterion("SCENE_UNEXPLAINED", float(evidence.explained_coarsely[index]) - options.min_explained_share)


def _unexplained(evidence: Evidence, index: int, unexplained: float) -> _Criterion:
    """Surface near the object that is no part of it: more is allowed where surface may never have been observed."""
    noise = float(evidence.residual_rms[index])
    without_noise = VERDICT.unexplained_observed if evidence.partial else VERDICT.unexplained
    allowed = without_noise + VERDICT.unexplained_per_noise * noise
    return _Criterion("SURFACE_UNEXPLAINED", allowed - unexplained)
