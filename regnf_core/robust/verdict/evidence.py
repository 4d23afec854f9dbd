"""What the held-out samples tell of poses, in numbers; ``criteria`` makes a verdict of them.

Both directions count: how much of the object's surface the scene confirms, and how much of the scene's surface the
object explains. Where the scene is free although the object should be there, the pose is wrong. Where the scene has
matter instead, the part may be occluded (fields are solid behind what was observed), and it does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from regnf_core.options import RobustOptions
from regnf_core.robust.constants import EVIDENCE
from regnf_core.robust.refine.loss import disagreement
from regnf_core.robust.residuals import Residuals


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the held-out samples tell of the poses (H,): shares 0..1, lengths in object diameters."""

    scores: Tensor
    share_object: Tensor
    """Object samples that the scene confirms, of those that are not occluded."""
    share_scene: Tensor
    """Scene samples near the object that it explains."""
    share_explained: Tensor
    """Scene samples, near or not, that the object explains."""
    occluded: Tensor
    """Object samples within the scene's matter, or at places that were not observed."""
    violations: Tensor
    """Object samples in the scene's free space, of those that are not occluded."""
    residual_rms: Tensor
    """Root mean square of the inliers' residuals."""
    coarse: Tensor
    """Coarse agreement: the share of samples, the smaller one of both directions, that agree at twice the inlier
    distance, whatever the normals, minus the share in free space."""
    offsets: Tensor
    """How much farther out the scene's surface lies than the object's."""
    scene_signs: Tensor
    """(H, N) uint8, see :class:`regnf_core.result.Considered`."""
    object_signs: Tensor
    """(H, M) uint8, likewise."""
    partial: bool = False
    """Part of the scene is known not to have been observed. That part is left out; the rest was measured."""

    def to(self, device: torch.device | str) -> Evidence:
        """The same on another device."""
        return Evidence(**{name: one.to(device) for name, one in self._tensors().items()}, partial=self.partial)

    @classmethod
    def cat(cls, parts: Sequence[Evidence]) -> Evidence:
        """The evidence on the poses of several batches, all on the same samples."""
        rows = [one._tensors() for one in parts]
        joined = {name: torch.cat([row[name] for row in rows]) for name in rows[0]}
        return cls(**joined, partial=parts[0].partial)

    def _tensors(self) -> dict[str, Any]:
        return {one.name: getattr(self, one.name) for one in fields(self) if one.name != "partial"}

    def of(self, index: int) -> dict[str, float]:
        """The numbers of one pose, by the names that results carry."""
        return {
            "score": float(self.scores[index]),
            "inlier_share_object": float(self.share_object[index]),
            "inlier_share_scene": float(self.share_scene[index]),
            "explained_share_scene": float(self.share_explained[index]),
            "occluded_share_object": float(self.occluded[index]),
            "free_space_violations": float(self.violations[index]),
            "residual_rms": float(self.residual_rms[index]),
            "coarse_agreement": float(self.coarse[index]),
            "surface_offset": float(self.offsets[index]),
        }


@dataclass(frozen=True, eq=False)
class HeldOut:
    """What the held-out samples tell of H poses, on the CPU: all that a verdict is made of, asked of the fields once.

    features: each (H,), by its name, see :mod:`.pose_features` · admitted: (H,) bool, which of the poses the detection
    allows.
    """

    evidence: Evidence
    features: dict[str, Tensor]
    admitted: Tensor

    @classmethod
    def cat(cls, parts: Sequence[HeldOut]) -> HeldOut:
        """Of several batches of poses, all on the same samples, one after the other."""
        return cls(
            Evidence.cat([one.evidence for one in parts]),
            {name: torch.cat([one.features[name] for one in parts]) for name in parts[0].features},
            torch.cat([one.admitted for one in parts]),
        )

    def of(self, index: int) -> dict[str, float]:
        """The numbers of one pose, by the names that results carry."""
        return {**self.evidence.of(index), "unexplained_share_scene": float(self.features["unexplained"][index])}


def gather_evidence(r: Residuals, offsets: Tensor, options: RobustOptions) -> Evidence:
    """The evidence of the residuals of held-out samples under H poses. offsets: (H,), as the residuals have them."""
    n, limit = r.scene_count, options.inlier_distance
    to_scene = r.object_to_scene
    inlier = (r.values.abs() <= limit) & (r.cosines >= EVIDENCE.min_inlier_cosine)
    observed = torch.ones_like(to_scene, dtype=torch.bool) if r.unobserved is None else ~r.unobserved[:, n:]
    occluded = (~observed | (to_scene < -limit)) & ~inlier[:, n:]
    visible = (~occluded).sum(1).clamp_min(1)
    near = r.scene_to_object.abs() <= EVIDENCE.near
    if r.unobserved is not None:
        near &= ~r.unobserved[:, :n]
    free = (to_scene > limit) & observed
    squares = torch.where(inlier, r.values.square(), 0.0).sum(1)
    return Evidence(
        scores=disagreement(r, EVIDENCE.score_width),
        share_object=inlier[:, n:].sum(1) / visible,
        share_scene=inlier[:, :n].sum(1) / near.sum(1).clamp_min(1),
        share_explained=inlier[:, :n].float().mean(1),
        occluded=occluded.float().mean(1),
        violations=free.sum(1) / visible,
        residual_rms=(squares / inlier.sum(1).clamp_min(1)).sqrt(),
        coarse=_coarse(r, near, observed, EVIDENCE.coarse_distance * limit),
        offsets=offsets,
        scene_signs=_signs((~inlier[:, :n] & near, 1), (~inlier[:, :n] & ~near, 2)),
        object_signs=_signs((~inlier[:, n:], 3), (occluded, 2), (free, 1)),
        partial=r.unobserved is not None,
    )


def _signs(*marked: tuple[Tensor, int]) -> Tensor:
    """(H, N) uint8: the number of the last that marks each sample; 0 where none does."""
    signs = torch.zeros_like(marked[0][0], dtype=torch.uint8)
    for where, number in marked:
        signs.masked_fill_(where, number)
    return signs


def _coarse(r: Residuals, near: Tensor, observed: Tensor, distance: float) -> Tensor:
    """``coarse`` of the evidence, (H,).

    near: (H, N) scene samples near the object · observed: (H, M) object samples at places that were observed.
    """
    to_scene = r.object_to_scene
    explained = r.scene_to_object.abs() <= distance
    of_near = explained.sum(1) / near.sum(1).clamp_min(1)
    of_object = (observed & (to_scene.abs() <= distance)).sum(1) / observed.sum(1).clamp_min(1)
    free = (observed & (to_scene > distance)).sum(1) / (observed & (to_scene >= -distance)).sum(1).clamp_min(1)
    agreement: Tensor = torch.minimum(of_near, of_object) - free
    return agreement
