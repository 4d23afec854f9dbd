"""The verdict on a pose: whether it is probable enough, and where it is not, what is wrong with it in words.

The probability (:mod:`.probability`) holds all the evidence together. It decides where it is high or low. Between, a
pose has to keep the limits of three shares too, which are options: another object of the same kind, a chair in another
chair's place, may be as probable, but little of its surface agrees, or much of it stands in free space. In addition

- little of the object may be left that was seen: of such poses the probability knows nothing;
- the scene may have surface within the object's hull that belongs to another, similar object. It fits as well, so this
  is asked for by itself where it is known what was seen. Elsewhere a field may have invented that surface.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from regnf_core.options import RobustOptions
from regnf_core.result import Verdict
from regnf_core.robust.constants import VERDICT
from regnf_core.robust.verdict.evidence import Evidence


@dataclass(frozen=True)
class PoseVerdict:
    """A verdict, its reason (a stable UPPER_SNAKE word), and by what share 0..1 the narrowest of its limits was kept;
    negative where it was not, that is, where the pose is rejected."""

    verdict: Verdict
    reason: str
    margin: float


@dataclass(frozen=True)
class _Limit:
    """slack: by how much it is kept, negative where it is not."""

    reason: str
    slack: float

    @property
    def kept(self) -> bool:
        """False for a slack that is not a number."""
        return self.slack >= 0.0


def evaluate_pose(
    evidence: Evidence,
    index: int,
    rivals: int,
    options: RobustOptions,
    features: Mapping[str, float],
    probability: float,
) -> PoseVerdict:
    """The verdict on pose number ``index`` of the evidence, which ``rivals`` other poses equal.

    features: of this pose, see :mod:`.pose_features` · probability: that the pose or one of its rivals is right, 0..1.
    Written so that a number that is not finite can only lead to a rejection.
    """
    limits = [
        _Limit("TOO_LITTLE_SURFACE", options.max_occluded_share - float(evidence.occluded[index])),
        _Limit("TOO_LITTLE_SURFACE", VERDICT.max_hidden - features["hidden"]),
        *_of_a_similar_object(evidence, index, features),
        *_of_the_shares(evidence, index, options, probability),
        _Limit("LOW_PROBABILITY", probability - min(VERDICT.min_probability, options.min_probability)),
    ]
    margin = min(-1.0 if math.isnan(one.slack) else one.slack for one in limits)
    broken = next((one for one in limits if not one.kept), None)
    if broken is not None:
        return PoseVerdict("rejected", broken.reason, margin)
    if rivals:
        return PoseVerdict("ambiguous", "SEVERAL_POSES_AGREE", margin)
    return PoseVerdict("registered", "SURFACES_AGREE", margin)


def _of_a_similar_object(evidence: Evidence, index: int, features: Mapping[str, float]) -> Iterable[_Limit]:
    if not (evidence.partial or features["hidden"] > VERDICT.mostly_hidden):
        return
    allowed = VERDICT.unexplained + VERDICT.unexplained_per_noise * float(evidence.residual_rms[index])
    yield _Limit("SURFACE_UNEXPLAINED", allowed - features["unexplained"])


def _of_the_shares(evidence: Evidence, index: int, options: RobustOptions, probability: float) -> Iterable[_Limit]:
    """None where the pose is probable enough without."""
    if probability >= options.min_probability:
        return
    yield _Limit("FREE_SPACE_VIOLATED", options.max_free_space_violations - float(evidence.violations[index]))
    yield _Limit("LOW_OVERLAP", float(evidence.share_object[index]) - options.min_inlier_share)
    yield _Limit("LOW_OVERLAP", float(evidence.share_scene[index]) - options.min_inlier_share)
    yield _Limit("SCENE_UNEXPLAINED", float(evidence.share_explained[index]) - options.min_explained_share)
