"""A place of the scene that is cleared: its matter taken away, the ground beneath and behind continued."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.editing.ground import Ground, ground_of
from regnf_core.editing.neighbors import kept_neighbors, near_thing
from regnf_core.editing.placed_object import PlacedObject
from regnf_core.editing.region import GridDistance, box_distance
from regnf_core.editing.support import support_planes
from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox

_BOX_MARGIN = 0.05
"""How far beyond a thing's box its copy in the scene may reach, as a share of the box's diagonal."""
_OWN_MARGIN = 0.015
"""The same of the thing's surface, and 3 times the registration's residual."""
_OVERLAP = 0.004
"""Of the box's diagonal: the continued ground reaches so far into the matter round it, and leaves no gap."""


@dataclass(frozen=True, eq=False)
class Limits:
    """What a clearing makes of a scene's distances (N,): min(max(distance, least), most), with gradients (N, 3).

    As solids: the scene less the box (but for what is kept), and the ground. most: None without ground.
    """

    least: Tensor
    least_slope: Tensor
    most: Tensor | None
    most_slope: Tensor | None

    def apply(self, distance: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """The distance (N,) of the cleared scene where the scene's own is ``distance``, and its gradient (N, 3)."""
        distance, gradient = _larger(distance, gradient, self.least, self.least_slope)
        if self.most is None or self.most_slope is None:
            return distance, gradient
        distance, gradient = _larger(-distance, -gradient, -self.most, -self.most_slope)
        return -distance, -gradient


@dataclass(frozen=True, eq=False)
class Clearing:
    """box: what is cleared, but for ``kept`` · grounds: supports that go on through it."""

    box: OrientedBox
    kept: GridDistance | None
    grounds: Sequence[Ground]

    def reaches(self, points: Tensor) -> Tensor:
        """(N,) distance to what may be changed, negative within, less the overlap."""
        return box_distance(self.box, points) - self._overlap

    def limits(self, points: Tensor, with_gradient: bool) -> Limits:
        """Between which the cleared scene's distance lies at points (N, 3), whatever the scene's own is.

        Without gradients the slopes mean nothing.
        """
        box, outward = self._box(points)
        removed, away = box, outward
        if self.kept is not None:
            kept, slope = self.kept.at_with_gradient(points) if with_gradient else (self.kept.at(points), outward)
            removed, away = _larger(box, outward, -kept, -slope)
        if not self.grounds:
            return Limits(-removed, -away, None, None)
        ground, slope = self._ground(points)
        filled, slope = _larger(ground, slope, box - self._overlap, outward)
        return Limits(-removed, -away, filled, slope)

    @property
    def _overlap(self) -> float:
        return _OVERLAP * self.box.diagonal

    def _ground(self, points: Tensor) -> tuple[Tensor, Tensor]:
        distance, gradient = self.grounds[0].distance(points)
        for ground in self.grounds[1:]:
            other, slope = ground.distance(points)
            distance, gradient = _larger(-distance, -gradient, -other, -slope)
            distance, gradient = -distance, -gradient
        return distance, gradient

    def _box(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The box's signed distance (N,) and its gradient (N, 3)."""
        local = self.box.to_local(points)
        beyond = local.abs() - self.box.size.to(points) / 2.0
        out = beyond.clamp_min(0.0)
        outside = out.norm(dim=-1)
        deepest, axis = beyond.max(dim=-1)
        inward = torch.nn.functional.one_hot(axis, 3).to(points)
        slope = torch.where((deepest > 0)[:, None], out / outside.clamp_min(1e-12)[:, None], inward)
        slope = slope * torch.where(local < 0, -1.0, 1.0)
        distance = torch.where(deepest > 0, outside, deepest)
        return distance, slope @ self.box.rotation.to(points).T


def clear_thing(scene: SdfField, thing: PlacedObject, residual: float, generator: torch.Generator) -> Clearing:
    """Clear the scene's copy of a thing. residual: of its registration, scene units."""
    own = _OWN_MARGIN * thing.box.diagonal + 3.0 * residual
    margin = _BOX_MARGIN * thing.box.diagonal + residual
    box = OrientedBox(thing.box.center, thing.box.size + 2.0 * margin, thing.box.rotation)
    planes = support_planes(scene, thing.box, generator)
    belongs = near_thing(thing, own)
    kept = kept_neighbors(scene, box, planes, belongs)
    grounds = (ground_of(scene, plane, box, belongs) for plane in planes)
    return Clearing(box, kept, [ground for ground in grounds if ground is not None])


def clear_box(scene: SdfField, box: OrientedBox, generator: torch.Generator) -> Clearing:
    """Clear a box in which nobody knows the thing's surface."""
    grown = OrientedBox(box.center, box.size + 2.0 * _BOX_MARGIN * box.diagonal, box.rotation)
    planes = support_planes(scene, box, generator)
    kept = kept_neighbors(scene, grown, planes, None)
    grounds = (ground_of(scene, plane, grown, None) for plane in planes)
    return Clearing(grown, kept, [ground for ground in grounds if ground is not None])


def _larger(a: Tensor, slope_a: Tensor, b: Tensor, slope_b: Tensor) -> tuple[Tensor, Tensor]:
    """The larger of two distances (N,), with its gradient (N, 3): what both solids share."""
    first = a >= b
    return torch.where(first, a, b), torch.where(first[:, None], slope_a, slope_b)
