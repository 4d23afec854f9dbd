"""The verdict on a pose: whether it is probable enough, and where it is not, what is wrong with it in words.

The probability (:mod:`.probability`) holds all the evidence together. Below the option ``min_probability`` nothing is
accepted. Below ``share_limits_below`` a pose has to keep the limits of three shares too, which are options: another
object of the same kind, a chair in another chair's place, may be as probable, but little of its surface agrees, or much
of it stands in free space. In addition

- the object must stand within the detection, give or take;
- little of the object may be left that was seen: of such poses the probability knows nothing;
- the scene may have surface within the object's hull that belongs to another, similar object. It fits as well, so this
  is asked for by itself where it is known what was seen. Elsewhere a field may have invented that surface.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from regnf_core.options import RobustOptions
from regnf_core.result import Verdict
from regnf_core.robust.constants import VERDICT
from regnf_core.robust.verdict.evidence import Evidence, HeldOut


@dataclass(frozen=True)
class PoseVerdict:
    """A verdict and its reason (a stable UPPER_SNAKE word).

    margin: by what share 0..1 the narrowest of its limits was kept; negative where it was not, that is, where the pose
    is rejected · broken: the limit that was not kept, in words with both numbers; "" where the reason says it all.
    """

    verdict: Verdict
    reason: str
    margin: float
    broken: str = ""


@dataclass(frozen=True)
class _Limit:
    """A number of a pose and what it may be. name: in words · upper: whether the limit is the most that is allowed."""

    reason: str
    name: str
    value: float
    limit: float
    upper: bool = False

    @property
    def slack(self) -> float:
        """By how much it is kept, negative where it is not; -1 for a number that is none."""
        slack = self.limit - self.value if self.upper else self.value - self.limit
        return -1.0 if math.isnan(slack) else slack

    def __str__(self) -> str:
        value, limit = f"{self.value:.3g}", f"{self.limit:.3g}"
        if value == limit:  # 0.6996 is not "0.7, at least 0.7"
            value, limit = str(self.value), str(self.limit)
        return f"{self.name} {value}, " + (
            f"at most {limit} is allowed" if self.upper else f"at least {limit} is needed"
        )


def evaluate_pose(
    held_out: HeldOut, index: int, rivals: int, options: RobustOptions, probability: float
) -> PoseVerdict:
    """The verdict on pose number ``index``, which ``rivals`` other poses equal.

    probability: that the pose or one of its rivals is right, 0..1.
    Written so that a number that is not finite can only lead to a rejection.
    """
    evidence, features = held_out.evidence, {name: float(one[index]) for name, one in held_out.features.items()}
    occluded = float(evidence.occluded[index])
    limits = [
        _Limit("TOO_LITTLE_SURFACE", "occluded share", occluded, options.max_occluded_share, upper=True),
        _Limit("TOO_LITTLE_SURFACE", "hidden share", features["hidden"], VERDICT.max_hidden, upper=True),
        *_of_a_similar_object(evidence, index, features),
        *_of_the_shares(evidence, index, options, probability),
        _Limit("LOW_PROBABILITY", "probability", probability, options.min_probability),
    ]
    margin = min(one.slack for one in limits)
    if not bool(held_out.admitted[index]):
        return PoseVerdict("rejected", "OUTSIDE_DETECTION", -1.0)
    broken = next((one for one in limits if not one.slack >= 0.0), None)
    if broken is not None:
        return PoseVerdict("rejected", broken.reason, margin, str(broken))
    if rivals:
        return PoseVerdict("ambiguous", "SEVERAL_POSES_AGREE", margin)
    return PoseVerdict("registered", "SURFACES_AGREE", margin)


def _of_a_similar_object(evidence: Evidence, index: int, features: dict[str, float]) -> Iterable[_Limit]:
    if not (evidence.partial or features["hidden"] > VERDICT.mostly_hidden):
        return
    allowed = VERDICT.unexplained + VERDICT.unexplained_per_noise * float(evidence.residual_rms[index])
    yield _Limit("SURFACE_UNEXPLAINED", "unexplained share", features["unexplained"], allowed, upper=True)


def _of_the_shares(evidence: Evidence, index: int, options: RobustOptions, probability: float) -> Iterable[_Limit]:
    """None where the pose is probable enough without."""
    if options.share_limits_below < 1.0 and probability >= options.share_limits_below:
        return
    free, enough = float(evidence.violations[index]), options.min_inlier_share
    yield _Limit("FREE_SPACE_VIOLATED", "share in free space", free, options.max_free_space_violations, upper=True)
    yield _Limit("LOW_OVERLAP", "object inliers", float(evidence.share_object[index]), enough)
    yield _Limit("LOW_OVERLAP", "scene inliers", float(evidence.share_scene[index]), enough)
    explained = float(evidence.share_explained[index])
    yield _Limit("SCENE_UNEXPLAINED", "explained share", explained, options.min_explained_share)
