"""What the held-out samples say of poses, in numbers; ``judgment`` makes a verdict of them.

Two-sided: how much of the object's surface the scene confirms, and how much of the scene's surface the object explains.
Where the scene is free although the object should be there, the pose is wrong; where the scene holds matter instead,
the part may just never have been seen (fields are solid behind what was seen), and counts for nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RobustOptions
from regnf_core.robust.residuals import DistanceModel, Samples, residuals
from regnf_core.robust.search.search import disagreement

_SCORE_WIDTH = 0.015  # object diameters
REACH = 0.1  # object diameters from the object's surface: scene points farther off belong to something else
_COARSE = 2.0  # inlier distances
_CORE, _TAIL = 0.3, 0.75
"""Quantiles of the residuals' sizes."""
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
    coarse: Tensor
    """What both directions agree on at twice the distance, whatever the normals, less the share in free space."""
    tail: Tensor
    """How long the residuals' tail is: 3 for normal errors that are alike everywhere."""
    explained_coarsely: Tensor
    """Scene samples, near or not, that the object explains at twice the distance."""
    offsets: Tensor
    """How much farther out the scene's surface lies than the object's."""
    partial: bool = False
    """Part of the scene is known not to have been seen; what was not is set aside, and the rest was measured."""

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
            "coarse_agreement": float(self.coarse[index]),
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
    seen = torch.ones_like(back, dtype=torch.bool) if r.unseen is None else ~r.unseen[:, n:]
    hidden = (~seen | (back < -options.inlier_distance)) & ~inlier[:, n:]
    violating = (back > options.inlier_distance) & seen
    open_ = (~hidden).sum(1).clamp_min(1)
    near = forth.abs() <= REACH
    distance = _COARSE * options.inlier_distance
    coarse, explained_coarsely = _coarse(forth, back, near, seen, distance)
    squares = torch.where(inlier, r.values.square(), 0.0).sum(1)
    return Evidence(
        scores=disagreement(r, _SCORE_WIDTH),
        share_object=inlier[:, n:].sum(1) / open_,
        share_scene=inlier[:, :n].sum(1) / near.sum(1).clamp_min(1),
        share_explained=inlier[:, :n].float().mean(1),
        hidden=hidden.float().mean(1),
        violations=violating.sum(1) / open_,
        residual_rms=(squares / inlier.sum(1).clamp_min(1)).sqrt(),
        coarse=coarse,
        tail=_tail(r.values if r.unseen is None else r.values.masked_fill(r.unseen, torch.nan)),
        explained_coarsely=explained_coarsely,
        offsets=offsets,
        partial=r.unseen is not None,
    )


def _coarse(forth: Tensor, back: Tensor, near: Tensor, seen: Tensor, distance: float) -> tuple[Tensor, Tensor]:
    """``coarse`` and ``explained_coarsely`` of the evidence, (H,) each. seen: (H, M), where the scene was looked at."""
    explained = forth.abs() <= distance
    of_near = explained.sum(1) / near.sum(1).clamp_min(1)
    of_object = (seen & (back.abs() <= distance)).sum(1) / seen.sum(1).clamp_min(1)
    free = (seen & (back > distance)).sum(1) / (seen & (back >= -distance)).sum(1).clamp_min(1)
    return torch.minimum(of_near, of_object) - free, explained.float().mean(1)


def _tail(values: Tensor) -> Tensor:
    core, tail = torch.nanquantile(values.abs(), torch.tensor([_CORE, _TAIL]), dim=1)
    longer: Tensor = tail / core.clamp_min(1e-9)
    return longer
