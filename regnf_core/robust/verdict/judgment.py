"""The verdict, on samples that the refinement has not seen, and by what margin it was reached.

Where the scene's field is rough, the right object misses the distance that accurate fields keep to, and normals say
little. There a second measure may stand in: what agrees at twice the distance, whatever the normals, less the share of
the object that lies in free space by more than that. Another thing's shape is wrong by more than roughness explains.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from regnf_core.options import RobustOptions
from regnf_core.result import Verdict
from regnf_core.robust.verdict.evidence import Evidence

_CLEAN_VIOLATIONS, _VIOLATIONS_PER_NOISE = 0.05, 20.0
_CLEAN_SHARE, _SHARE_PER_NOISE = 0.89, 45.0
"""Where the inliers agree to a thousandth of the diameter, a tenth of the surface that does not agree is another thing
(a chair without its cushion); where they agree to a hundredth, it may be the fields' errors."""
_EXTRA, _EXTRA_PER_NOISE = 0.03, 20.0
_EXTRA_MEASURED, _EXTRA_PER_NOISE_MEASURED = 0.05, 4.0
"""A fit to images invents surface where nobody looked, the more the noisier it is; what was measured is there."""
_LEAST_COARSE, _LEAST_COARSE_OF_PARTS = 0.68, 0.72
_LEAST_COARSE_OF_MEASURED, _MOST_HIDDEN, _MOST_OFFSET = 0.78, 0.6, 0.015
_ROUGH, _ROUGH_SCORE, _SCORE_PER_INCOHERENCE = 0.022, 0.5, 12.0
"""From so incoherent normals on a field counts as rough, and the score may be as bad as they explain."""
_LONGEST_TAIL = 5.5
"""3 for normal errors everywhere. Another thing's residuals are small where it is alike and large where it is not."""


@dataclass(frozen=True)
class Decision:
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
        """False for a number that is none."""
        return self.slack >= 0.0


def decide(
    evidence: Evidence,
    index: int,
    rivals: int,
    options: RobustOptions,
    incoherence: float = 0.0,
    extra: float = 0.0,
) -> Decision:
    """What is to be said of one pose that has ``rivals`` equals. incoherence: of the scene's normals · extra: share of
    the surface near the object that is no part of it, see :mod:`regnf_core.robust.verdict.unexplained_surface`.

    Written so that a number that is none can only lead to a rejection.
    """
    hidden = _Criterion("TOO_LITTLE_SURFACE", options.max_hidden_share - float(evidence.hidden[index]))
    accurate = list(_of_accurate_fields(evidence, index, options))
    joined = _extra(evidence, index, extra)
    rough = _least(_of_rough_fields(evidence, index, options, incoherence))
    agreement = max(_least(accurate), rough, _least(_of_measured_surface(evidence, index, options)))
    margin = min(_least([hidden, joined]), agreement)
    if not margin >= 0.0:
        asked = [hidden, accurate[0], joined, *accurate[1:]] if not agreement >= 0.0 else [hidden, joined]
        return Decision("rejected", next(one.reason for one in asked if not one.met), margin)
    if rivals:
        return Decision("ambiguous", "SEVERAL_POSES_AGREE", margin)
    return Decision("registered", "SURFACES_AGREE", margin)


def _least(criteria: Iterable[_Criterion]) -> float:
    """The smallest slack; -1 where one is no number."""
    return min((-1.0 if math.isnan(one.slack) else one.slack for one in criteria), default=-1.0)


def _of_accurate_fields(evidence: Evidence, index: int, options: RobustOptions) -> Iterable[_Criterion]:
    noise = float(evidence.residual_rms[index])
    violations = min(options.max_free_space_violations, _CLEAN_VIOLATIONS + _VIOLATIONS_PER_NOISE * noise)
    of_scene = max(options.min_inlier_share, _CLEAN_SHARE - _SHARE_PER_NOISE * noise)
    yield _Criterion("FREE_SPACE_VIOLATED", violations - float(evidence.violations[index]))
    yield _Criterion("LOW_OVERLAP", float(evidence.share_object[index]) - options.min_inlier_share)
    yield _Criterion("LOW_OVERLAP", float(evidence.share_scene[index]) - of_scene)
    yield _Criterion("SCENE_UNEXPLAINED", float(evidence.share_explained[index]) - options.min_explained_share)


def _of_rough_fields(
    evidence: Evidence, index: int, options: RobustOptions, incoherence: float
) -> Iterable[_Criterion]:
    """Whether the disagreement is what a field as rough as this leads to at the right pose."""
    if not incoherence >= _ROUGH:
        return
    score = _ROUGH_SCORE + _SCORE_PER_INCOHERENCE * (incoherence - _ROUGH)
    yield _Criterion("LOW_OVERLAP", score - float(evidence.scores[index]))
    yield _Criterion("LOW_OVERLAP", 1.0 - float(evidence.tail[index]) / _LONGEST_TAIL)
    least = _LEAST_COARSE_OF_PARTS if evidence.partial else _LEAST_COARSE
    yield _Criterion("LOW_OVERLAP", float(evidence.coarse[index]) - least)
    if evidence.partial:
        yield _Criterion("TOO_LITTLE_SURFACE", _MOST_HIDDEN - float(evidence.hidden[index]))
    yield _Criterion("SCENE_UNEXPLAINED", float(evidence.explained_coarsely[index]) - options.min_explained_share)


def _of_measured_surface(evidence: Evidence, index: int, options: RobustOptions) -> Iterable[_Criterion]:
    """Where what nobody saw has been set aside, both shapes agree at twice the distance, however smooth the field; on
    enough of the object, and without an offset that makes one thing another."""
    if not evidence.partial:
        return
    yield _Criterion("TOO_LITTLE_SURFACE", _MOST_HIDDEN - float(evidence.hidden[index]))
    yield _Criterion("LOW_OVERLAP", 1.0 - float(evidence.tail[index]) / _LONGEST_TAIL)
    yield _Criterion("LOW_OVERLAP", float(evidence.coarse[index]) - _LEAST_COARSE_OF_MEASURED)
    yield _Criterion("LOW_OVERLAP", _MOST_OFFSET - abs(float(evidence.offsets[index])))
    yield _Criterion("SCENE_UNEXPLAINED", float(evidence.explained_coarsely[index]) - options.min_explained_share)


def _extra(evidence: Evidence, index: int, extra: float) -> _Criterion:
    """Surface near the object that is no part of it: more may be where it may never have been seen."""
    noise = float(evidence.residual_rms[index])
    measured = _EXTRA_MEASURED + _EXTRA_PER_NOISE_MEASURED * noise
    most = measured if evidence.partial else _EXTRA + _EXTRA_PER_NOISE * noise
    return _Criterion("SURFACE_UNEXPLAINED", most - extra)
