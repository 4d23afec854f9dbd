"""An object's field where it stands in a scene: exact within its bounds, a lower bound of the distance outside."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3

_MARGIN = 0.04
"""How much larger than the surface the box is in which the object's field is asked."""


class PlacedObject:
    """S(x) = S_object(T x) / s within a box round the object's surface, for T = ``T_object_scene`` with scale s.

    Outside of the box, where a trained field means nothing, sqrt(b^2 + S(p)^2) with b the distance to the box and p its
    nearest point: the surface lies in the box, which is convex, so the distance is no smaller (the angle at p between
    the ways to x and to the surface is 90 degrees or more). It is continuous, and exact to first order at the box.
    """

    def __init__(self, obj: SdfField, T_object_scene: Sim3, surface: OrientedBox) -> None:
        self.obj = obj
        self.T_object_scene = T_object_scene
        self.surface = surface
        """The box of the object's surface, its own frame, axis-aligned."""
        low, high = obj.bounds
        reach = 0.5 * surface.size + _MARGIN * surface.size.norm()
        self._low = torch.maximum(surface.center - reach, low)
        self._high = torch.minimum(surface.center + reach, high)

    @property
    def scale(self) -> float:
        """Object units a scene unit."""
        return float(self.T_object_scene.scale)

    @property
    def box(self) -> OrientedBox:
        """Round the object's surface, scene frame."""
        back = self.T_object_scene.inverse()
        center = back.apply(self.surface.center[None])[0]
        return OrientedBox(center, self.surface.size / self.scale, back.rotation)

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU, of the surface's box, scene frame."""
        corners = self.box.corners()
        return torch.stack([corners.amin(0), corners.amax(0)])

    @property
    def device(self) -> torch.device:
        return self.obj.device

    def to(self, device: torch.device | str) -> PlacedObject:
        """The same with its parameters on another device."""
        return PlacedObject(self.obj.to(device), self.T_object_scene, self.surface)

    def distance_to_box(self, points: Tensor) -> Tensor:
        """(N,) scene units, 0 within: never more than the signed distance at points (N, 3) of the scene."""
        moved = self._moved(points)
        beyond: Tensor = (moved - self._nearest(moved)).norm(dim=-1)
        return beyond / self.scale

    def signed_distance(self, points: Tensor) -> Tensor:
        """(N,) float32, scene units, at points (N, 3) of the scene."""
        moved = self._moved(points)
        inside = self._nearest(moved)
        distance = self.obj.signed_distance(inside).to(moved)
        beyond = (moved - inside).norm(dim=-1)
        return torch.where(beyond > 0, torch.hypot(beyond, distance.clamp_min(0.0)), distance) / self.scale

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(N,) and (N, 3) at points (N, 3) of the scene."""
        moved = self._moved(points)
        inside = self._nearest(moved)
        distance, gradient = (value.to(moved) for value in self.obj.signed_distance_and_gradient(inside))
        offset = moved - inside
        beyond = offset.norm(dim=-1)
        free = distance.clamp_min(0.0)
        outside = torch.hypot(beyond, free)
        # Along an axis that leads out, the box's nearest point stays where it is.
        along = torch.where(offset == 0.0, gradient, 0.0)
        away = (offset + free[:, None] * along) / outside.clamp_min(1e-12)[:, None]
        out = beyond > 0
        gradient = torch.where(out[:, None], away, gradient)
        return torch.where(out, outside, distance) / self.scale, gradient @ self.T_object_scene.rotation.to(gradient)

    def _moved(self, points: Tensor) -> Tensor:
        return self.T_object_scene.apply(points.double().to(self.device)).float()

    def _nearest(self, moved: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(moved, self._low.to(moved)), self._high.to(moved))
