"""Planes that an object stands on or leans against, found in the scene's surface around its box."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.surface.result_clouds import project_to_surface

_DRAWN, _GROWN = 6000, 1.9
"""Points drawn around the box, within the box grown by this factor."""
_NEWTON_STEPS = 3
_CANDIDATES = 96
_MOST_PLANES = 4
_THICKNESS = 0.012
"""Of the box's diagonal: farthest that a point of a plane is from it."""
_FACING = 0.85
_LEAST_SHARE, _LEAST_POINTS = 0.06, 40
_IN_FRONT = 0.6
"""Least share of the box's volume before a plane of support, and of its neighborhood's surface."""
_BINS = 6


@dataclass(frozen=True, eq=False)
class SupportPlane:
    """normal: (3,) unit float64, towards the box · offset: n . x of its points · roughness: median height of the
    surface above or below it."""

    normal: Tensor
    offset: float
    roughness: float

    def height(self, points: Tensor) -> Tensor:
        """(N,) of points (N, 3), positive on the side of the box."""
        return points @ self.normal.to(points) - self.offset


def support_planes(scene: SdfField, box: OrientedBox, generator: torch.Generator) -> list[SupportPlane]:
    """The planes that cross or nearly touch ``box`` and go on around it, the largest first; none where there are none.

    RANSAC over the surface outside of the box. A plane counts if most of the box lies before it, and if its points lie
    on several sides of the box: a neighbor's face has them on one.
    """
    points, normals = _surface_around(scene, box, generator)
    found: list[SupportPlane] = []
    total = len(points)
    while len(found) < _MOST_PLANES and len(points) >= max(_LEAST_POINTS, _LEAST_SHARE * total):
        plane, near = _best(points, normals, box, generator)
        if plane is None or int(near.sum()) < max(_LEAST_POINTS, _LEAST_SHARE * total):
            break
        found.append(plane)
        points, normals = points[~near], normals[~near]
    return found


def _surface_around(scene: SdfField, box: OrientedBox, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Points (N, 3) and unit normals of the scene's surface outside of the box and not far from it, on the CPU."""
    low, high = scene.bounds
    reach = torch.maximum(_GROWN * box.size, box.size + 0.35 * box.size.max())
    local = (torch.rand(_DRAWN, 3, generator=generator, dtype=torch.float64) - 0.5) * reach
    points = (box.center + local @ box.rotation.T).float()
    points = points[((points >= low) & (points <= high)).all(-1)]
    found = project_to_surface(scene.signed_distance_and_gradient, points.to(scene.device), _NEWTON_STEPS)
    at, distance = found.points.cpu(), found.distance.cpu()
    near = (distance.abs() <= 2e-3 * box.diagonal) & (box.to_local(at).abs() <= reach.float()).all(-1)
    near &= ~box.contains(at) & ((at >= low) & (at <= high)).all(-1)
    return at[near].double(), torch.nn.functional.normalize(found.gradient.cpu()[near].double(), dim=-1)


def _best(
    points: Tensor, normals: Tensor, box: OrientedBox, generator: torch.Generator
) -> tuple[SupportPlane | None, Tensor]:
    def near_plane(n: Tensor, offset: float) -> Tensor:
        return ((points @ n - offset).abs() <= _THICKNESS * box.diagonal) & (normals @ n >= _FACING)

    picks = torch.randperm(len(points), generator=generator)[:_CANDIDATES]
    best, best_near, most = None, torch.zeros(len(points), dtype=torch.bool), 0
    for n, p in zip(normals[picks], points[picks], strict=True):
        near = near_plane(n, float(n @ p))
        if int(near.sum()) <= max(most, 8):
            continue
        middle = points[near].mean(0)  # the plane of least squares, its normal on the side of ``n``
        thinnest = torch.linalg.eigh((points[near] - middle).T @ (points[near] - middle))[1][:, 0]
        n = thinnest * torch.sign(thinnest @ n)
        offset = float(n @ middle)
        near = near_plane(n, offset)
        if int(near.sum()) > most and _supports(n, offset, points[near], box):
            heights = points[near] @ n - offset
            best, best_near, most = SupportPlane(n, offset, float(heights.abs().median())), near, int(near.sum())
    return best, best_near


def _supports(n: Tensor, offset: float, on_plane: Tensor, box: OrientedBox) -> bool:
    """Whether the box stands before the plane and reaches it, and the plane goes on around the box's footprint."""
    heights = box.corners() @ n - offset
    extent = float(heights.max() - heights.min())
    if float(heights.min()) > 0.08 * box.diagonal or float(heights.max()) < _IN_FRONT * extent:
        return False
    first = torch.nn.functional.normalize(box.rotation[:, int((box.rotation.T @ n).abs().argmin())], dim=0)
    first = torch.nn.functional.normalize(first - (first @ n) * n, dim=0)
    second = torch.linalg.cross(n, first)
    aside = on_plane - box.center
    turn = torch.atan2(aside @ second, aside @ first)
    bins = torch.bincount(((turn / (2 * torch.pi) + 0.5) * _BINS).long().clamp(0, _BINS - 1), minlength=_BINS)
    return int((bins > 0.02 * len(on_plane)).sum()) > _BINS // 2


# An object's field where it stands in a scene: exact within its bounds, a lower bound of the distance outside.

_MARGIN = 0.04
"""How much larger than the surface the box is in which the object's field is asked."""


class PlacedObject:
    """S(x) = S_object(T x) / s within a box around the object's surface, for T = ``T_object_scene`` with scale s.

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
