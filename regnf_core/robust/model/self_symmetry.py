"""An object's own symmetries, found by registering it with itself: proposed on its samples, confirmed by its field."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.pose_distance import distinct
from regnf_core.geometry.sim3 import Sim3
from regnf_core.result import ObjectSymmetry
from regnf_core.robust.constants import MODEL
from regnf_core.robust.refine.coarse_to_fine import RefinementContext, coarse_to_fine
from regnf_core.robust.refine.levenberg_marquardt import Settings, minimize
from regnf_core.robust.refine.loss import disagreement
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.residuals import DistanceModel, SurfacePair, residuals
from regnf_core.robust.samples import Samples, subsample
from regnf_core.robust.search.rotations import turns_about
from regnf_core.robust.search.scale_bound import SAME_SCALE

_SCORE_WIDTH = MODEL.stages[-1].score_width


@dataclass(frozen=True, eq=False)
class SelfSymmetry:
    """Rigid transforms (K,) that carry the object, or most of it, onto itself; the identity is left out.

    axis: (3,) when every turn about it is a symmetry · deviation: (K,) the share of the surface that each transform
    does not carry onto the surface: near 0 for a symmetry, more for a transform that only resembles one.
    """

    T: Sim3
    axis: Tensor | None
    deviation: Tensor

    def to(self, device: torch.device | str) -> SelfSymmetry:
        """The same on another device."""
        axis = None if self.axis is None else self.axis.to(device)
        return SelfSymmetry(self.T.on(device), axis, self.deviation.to(device))

    def group(self) -> ObjectSymmetry:
        """The symmetries that the object's field confirms. On the CPU."""
        exact = self.T[self.deviation <= MODEL.max_deviating_share]
        omega = exact.log()[:, :3]
        if self.axis is not None:
            across = int((~_about(exact, self.axis)).sum())
            return ObjectSymmetry(1 + min(across, 1), _tuple(self.axis), True)
        axes = omega / omega.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        one_axis = len(axes) > 0 and bool(((axes @ axes[0]).abs() >= MODEL.min_parallel_cosine).all())
        return ObjectSymmetry(1 + len(axes), _tuple(axes[0]) if one_axis else None, False)


def propose_symmetries(
    obj: DistanceModel, B: Samples, extremal_points: Tensor, rotations: Tensor, generator: torch.Generator
) -> SelfSymmetry:
    """Likely symmetries of the object with the samples B (working frame, centroid at 0) and the distance model ``obj``.

    rotations: (K, 3, 3) to try, on the device of B and obj; what is found is on the CPU. The field still has to confirm
    it.
    """
    few = subsample(B, MODEL.points, generator)
    itself = SurfacePair(obj, obj, few, few)
    context = RefinementContext(extremal_points, generator, SAME_SCALE)
    found = coarse_to_fine(itself, PoseCandidates.start(_rigid(rotations)), MODEL.stages, context)
    max_score = _score_of_identity(itself) + MODEL.max_score_above_identity
    found = found[found.scores <= max_score].to("cpu")
    T = found.T[_distinct_symmetries(found.T, found.scores, extremal_points)]
    axis = _continuous_axis(itself, T, max_score)
    if axis is not None:
        turns = _rigid(turns_about(axis, MODEL.axis_representatives)[1:])
        T = Sim3.cat([T[~_about(T, axis)], turns])
    return SelfSymmetry(T, axis, torch.zeros(len(T)))


def confirm_symmetries(
    proposed: SelfSymmetry, obj: DistanceModel, B: Samples, extremal_points: Tensor, generator: torch.Generator
) -> SelfSymmetry:
    """The proposals refined on the object's own field, each with its deviation there.

    Costs nothing for an object without proposals, and some 4,000 field evaluations for each proposal.
    """
    if len(proposed.T) == 0:
        return proposed
    few = subsample(B, MODEL.confirming_points, generator)
    settings = Settings(scale=SAME_SCALE, normals=False)
    start = proposed.T.on(B.points.device)
    refined = minimize(SurfacePair(obj, obj, few, few), start, MODEL.confirming_widths, settings)
    deviation = (refined.residuals.values.abs() > MODEL.max_deviation).float().mean(1).cpu()
    found = refined.T.on("cpu")
    kept = _distinct_symmetries(found, deviation, extremal_points)
    T, deviation = found[kept], deviation[kept]
    axis = proposed.axis
    if axis is not None and bool((deviation[_about(T, axis)] > MODEL.max_deviating_share).any()):
        axis = None
    return SelfSymmetry(T, axis, deviation)


def _score_of_identity(itself: SurfacePair) -> float:
    identity = _rigid(torch.eye(3, dtype=torch.float64, device=itself.scene_samples.points.device)[None])
    return float(disagreement(residuals(itself, identity), _SCORE_WIDTH))


def _distinct_symmetries(T: Sim3, scores: Tensor, extremal_points: Tensor) -> Tensor:
    """Numbers of the best transforms; no two of them are alike, and none is like the identity."""
    points = extremal_points.double()
    moved = (T.apply(points) - points).norm(dim=-1).amax(-1)
    kept = distinct(T, scores, extremal_points, MODEL.min_distance, len(T) + 1)[: 2 * MODEL.max_symmetries]
    return kept[moved[kept] > MODEL.min_distance][: MODEL.max_symmetries]


def _rigid(rotations: Tensor) -> Sim3:
    """Rotations (K, 3, 3) as transforms (K,), float64."""
    rotations = rotations.double()
    return Sim3(torch.ones_like(rotations[:, 0, 0]), rotations, torch.zeros_like(rotations[:, 0]))


def _continuous_axis(itself: SurfacePair, T: Sim3, max_score: float) -> Tensor | None:
    """An axis (3,) about which every turn is a symmetry, if one of the proposals' axes is such."""
    low, high = MODEL.axis_angles
    for omega in T.log()[:, :3]:
        angle = float(omega.norm())
        if angle < low or angle > high:
            continue
        axis: Tensor = omega / omega.norm()
        turns = _rigid(turns_about(axis, MODEL.axis_turns).to(itself.scene_samples.points.device))
        if bool((disagreement(residuals(itself, turns), _SCORE_WIDTH) <= max_score).all()):
            return axis
    return None


def _tuple(axis: Tensor) -> tuple[float, float, float]:
    """A unit vector, its largest entry positive: an axis has no direction."""
    x, y, z = (axis * axis[axis.abs().argmax()].sign()).tolist()
    return x, y, z


def _about(T: Sim3, axis: Tensor) -> Tensor:
    """(K,) bool: which of the transforms turn about the axis."""
    omega = T.log()[:, :3]
    about: Tensor = (omega @ axis).abs() >= MODEL.min_axis_cosine * omega.norm(dim=-1)
    return about
