"""The verdict, on samples that the refinement has not seen.

Two-sided: how much of the object's surface the scene confirms, and how much of the scene's surface the object explains.
Where the scene is free although the object should be there, the pose is wrong; where the scene holds matter instead,
the part may just never have been seen (fields are solid behind what was seen), and counts for nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.options import RobustOptions
from regnf_core.result import Verdict
from regnf_core.robust.residuals import DistanceModel, Samples, residuals
from regnf_core.robust.search import disagreement
from regnf_core.sim3 import Sim3

_SCORE_WIDTH = 0.015  # object diameters
_REACH = 0.1  # object diameters from the object's surface: scene points farther off belong to something else
_CLEAN_VIOLATIONS, _VIOLATIONS_PER_NOISE = 0.05, 20.0
_CLEAN_SHARE, _SHARE_PER_NOISE = 0.87, 45.0
"""Where the inliers agree to a thousandth of the diameter, a tenth of the surface that does not agree is another thing
(a chair without its cushion); where they agree to a hundredth, it may be the fields' errors."""
_SAME_SIDE = 0.5  # least cosine of the normals of an inlier


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the held-out samples say of the poses (H,): shares 0..1, lengths in object diameters."""

    scores: Tensor
    share_object: Tensor
    """Object samples that the scene confirms, of those that it does not hide."""
    share_scene: Tensor
    """Scene samples near the object that it explains."""
    share_explained: Tensor
    """Scene samples, near or not, that the object explains."""
    hidden: Tensor
    """Object samples within the scene's matter."""
    violations: Tensor
    """Object samples in the scene's free space, of those that it does not hide."""
    residual_rms: Tensor
    """Root mean square of the inliers' residuals."""
    offsets: Tensor
    """How much farther out the scene's surface lies than the object's."""

    def of(self, index: int) -> dict[str, float]:
        """The numbers of one pose, by the names that results carry."""
        return {
            "score": float(self.scores[index]),
            "inlier_share_object": float(self.share_object[index]),
            "inlier_share_scene": float(self.share_scene[index]),
            "explained_share_scene": float(self.share_explained[index]),
            "hidden_share_object": float(self.hidden[index]),
            "free_space_violations": float(self.violations[index]),
            "residual_rms": float(self.residual_rms[index]),
            "surface_offset": float(self.offsets[index]),
        }


def gather_evidence(
    scene: DistanceModel,
    obj: DistanceModel,
    A: Samples,
    B: Samples,
    T: Sim3,
    options: RobustOptions,
    offsets: Tensor,
) -> Evidence:
    """Judge all poses T (H,), offsets (H,), on held-out samples A of the scene and B of the object, working frames."""
    r = residuals(scene, obj, A, B, T, offsets)
    n = r.scene_count
    forth, back = r.values[:, :n], r.values[:, n:]
    inlier = (r.values.abs() <= options.inlier_distance) & (r.cosines >= _SAME_SIDE)
    hidden = (back < -options.inlier_distance) & ~inlier[:, n:]
    violating = back > options.inlier_distance
    open_ = (~hidden).sum(1).clamp_min(1)
    near = forth.abs() <= _REACH
    squares = torch.where(inlier, r.values.square(), 0.0).sum(1)
    return Evidence(
        scores=disagreement(r, _SCORE_WIDTH),
        share_object=inlier[:, n:].sum(1) / open_,
        share_scene=inlier[:, :n].sum(1) / near.sum(1).clamp_min(1),
        share_explained=inlier[:, :n].float().mean(1),
        hidden=hidden.float().mean(1),
        violations=violating.sum(1) / open_,
        residual_rms=(squares / inlier.sum(1).clamp_min(1)).sqrt(),
        offsets=offsets,
    )


def verdict(evidence: Evidence, index: int, rivals: int, options: RobustOptions) -> tuple[Verdict, str]:
    """The verdict on one pose that has ``rivals`` equals, and its reason, a stable UPPER_SNAKE word.

    Written so that a number that is none can only lead to a rejection.
    """
    if not float(evidence.hidden[index]) <= options.max_hidden_share:
        return "rejected", "TOO_LITTLE_SURFACE"
    noise = float(evidence.residual_rms[index])
    if not float(evidence.violations[index]) <= min(
        options.max_free_space_violations, _CLEAN_VIOLATIONS + _VIOLATIONS_PER_NOISE * noise
    ):
        return "rejected", "FREE_SPACE_VIOLATED"
    if not float(evidence.share_object[index]) >= options.min_inlier_share:
        return "rejected", "LOW_OVERLAP"
    if not float(evidence.share_scene[index]) >= max(options.min_inlier_share, _CLEAN_SHARE - _SHARE_PER_NOISE * noise):
        return "rejected", "LOW_OVERLAP"
    if not float(evidence.share_explained[index]) >= options.min_explained_share:
        return "rejected", "SCENE_UNEXPLAINED"
    if rivals:
        return "ambiguous", "SEVERAL_POSES_AGREE"
    return "registered", "SURFACES_AGREE"
