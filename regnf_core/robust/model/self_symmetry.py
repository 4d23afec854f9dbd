"""An object's own symmetries, found by registering it with itself: proposed by its samples, confirmed by its field."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.pose_distance import distinct
from regnf_core.geometry.sim3 import Sim3
from regnf_core.result import ObjectSymmetry
from regnf_core.robust.refine.levenberg_marquardt import minimize
from regnf_core.robust.residuals import DistanceModel, Samples, residuals
from regnf_core.robust.samples import some
from regnf_core.robust.search.rotations import turns_about
from regnf_core.robust.search.search import disagreement

_POINTS = 200
_WIDTH = 0.02  # object diameters
_ALIKE = 0.35
"""Largest score, above that of the identity, of a turn that may be a symmetry: the fields decide afterwards."""
_MOST = 12
_APART = 0.08  # object diameters between two different symmetries
_AXIS_TURNS = 36
_CONFIRMING_POINTS = 300
_CONFIRMING_WIDTHS = [0.03, 0.02, 0.015, 0.01, 0.01, 0.01]
_OFF = 0.01  # object diameters
_EXACT = 0.03
"""Largest share of samples off by more than ``_OFF`` of a turn that is called a symmetry. Normals do not count: on the
rims of thin boards a fitted field has them anyhow."""
_PARALLEL = 0.99  # least cosine between the axes of turns about one axis


@dataclass(frozen=True, eq=False)
class SelfSymmetry:
    """Rigid transforms (K,) that carry the object, or most of it, onto itself; the identity is left out.

    axis: (3,) when every turn about it is one · deviation: (K,) the share of the surface that each does not carry onto
    the surface: near 0 for a symmetry, more for what merely resembles one.
    """

    T: Sim3
    axis: Tensor | None
    deviation: Tensor

    def group(self) -> ObjectSymmetry:
        """What the object's field calls its symmetries: exact turns alone."""
        exact = self.T[self.deviation <= _EXACT]
        omega = exact.log()[:, :3]
        if self.axis is not None:
            across = int((~_about(exact, self.axis)).sum())
            return ObjectSymmetry(1 + min(across, 1), _tuple(self.axis), True)
        axes = omega / omega.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        one_axis = len(axes) > 0 and bool(((axes @ axes[0]).abs() >= _PARALLEL).all())
        return ObjectSymmetry(1 + len(axes), _tuple(axes[0]) if one_axis else None, False)


def self_symmetry(
    obj: DistanceModel, B: Samples, extremes: Tensor, rotations: Tensor, generator: torch.Generator
) -> SelfSymmetry:
    """Likely symmetries of the object whose samples (working frame, centroid at 0) and distance model these are.

    rotations: (K, 3, 3) to try. What is found is a set of proposals.
    """
    few = some(B, _POINTS, generator)
    start = _rigid(rotations)
    coarse = disagreement(residuals(obj, obj, some(few, 48, generator), some(few, 48, generator), start), 0.1)
    T = start[coarse.argsort()[:80]]
    refined = minimize(obj, obj, few, few, T, [0.1, 0.07, 0.05, 0.03, 0.02, 0.02], fix_scale=True)
    scores = disagreement(refined.residuals, _WIDTH)
    itself = float(disagreement(residuals(obj, obj, few, few, _rigid(torch.eye(3)[None].double())), _WIDTH))
    alike = (scores <= itself + _ALIKE).nonzero().squeeze(-1)
    T, scores = refined.T[alike], scores[alike]
    kept = _distinct_turns(T, scores, extremes)
    T, scores = T[kept], scores[kept]
    axis = _continuous_axis(obj, few, T, itself)
    if axis is not None:
        across = ~_about(T, axis)
        turns = _rigid(turns_about(axis, 8)[1:])
        T = Sim3.cat([T[across], turns])
    return SelfSymmetry(T, axis, torch.zeros(T.scale.numel()))


def confirmed(
    proposed: SelfSymmetry, obj: DistanceModel, B: Samples, extremes: Tensor, generator: torch.Generator
) -> SelfSymmetry:
    """The proposals refined on the object's own field, each with its deviation there.

    Costs nothing for an object without proposals, and some 4,000 field evaluations for each.
    """
    if proposed.T.scale.numel() == 0:
        return proposed
    few = some(B, _CONFIRMING_POINTS, generator)
    refined = minimize(obj, obj, few, few, proposed.T, _CONFIRMING_WIDTHS, fix_scale=True)
    deviation = (refined.residuals.values.abs() > _OFF).float().mean(1)
    kept = _distinct_turns(refined.T, deviation, extremes)
    T, deviation = refined.T[kept], deviation[kept]
    axis = proposed.axis
    if axis is not None and bool((deviation[_about(T, axis)] > _EXACT).any()):
        axis = None
    return SelfSymmetry(T, axis, deviation)


def _distinct_turns(T: Sim3, scores: Tensor, extremes: Tensor) -> Tensor:
    """Numbers of the best, no two of them alike, none like the identity."""
    moved = (T.apply(extremes.double()) - extremes.double()).norm(dim=-1).amax(-1)
    kept = distinct(T, scores, extremes, _APART, T.scale.numel() + 1)[: 2 * _MOST]
    return kept[moved[kept] > _APART][:_MOST]


def _rigid(rotations: Tensor) -> Sim3:
    count = rotations.shape[0]
    return Sim3(torch.ones(count).double(), rotations.double(), torch.zeros(count, 3).double())


def _continuous_axis(obj: DistanceModel, B: Samples, T: Sim3, itself: float) -> Tensor | None:
    """An axis (3,) about which every turn is a symmetry, if one of the symmetries' axes is such."""
    for omega in T.log()[:, :3]:
        angle = float(omega.norm())
        if angle < 0.1 or angle > 3.0:  # half turns say little: what is round has others too
            continue
        axis: Tensor = omega / omega.norm()
        scores = disagreement(residuals(obj, obj, B, B, _rigid(turns_about(axis, _AXIS_TURNS))), _WIDTH)
        if bool((scores <= itself + _ALIKE).all()):
            return axis
    return None


def _tuple(axis: Tensor) -> tuple[float, float, float]:
    """A unit vector, its largest entry positive: an axis has no sense."""
    x, y, z = (axis * axis[axis.abs().argmax()].sign()).tolist()
    return x, y, z


def _about(T: Sim3, axis: Tensor) -> Tensor:
    """(K,) bool: which of the transforms turn about the axis."""
    omega = T.log()[:, :3]
    about: Tensor = (omega @ axis).abs() >= 0.97 * omega.norm(dim=-1)
    return about
