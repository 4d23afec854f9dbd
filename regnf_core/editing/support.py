"""Planes that a thing stands on or leans against, found in the scene's surface round its box."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.surface.projection import project_to_surface

_DRAWN, _GROWN = 6000, 1.9
"""Points drawn round the box, within the box grown by this factor."""
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
    """The planes that cross or nearly touch ``box`` and go on round it, the largest first; none where there are none.

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
    picks = torch.randperm(len(points), generator=generator)[:_CANDIDATES]
    best, best_near, most = None, torch.zeros(len(points), dtype=torch.bool), 0
    for n, p in zip(normals[picks], points[picks], strict=True):
        near = _near(points, normals, n, float(n @ p), box)
        if int(near.sum()) <= max(most, 8):
            continue
        n, offset = _fitted(points[near], n)
        near = _near(points, normals, n, offset, box)
        if int(near.sum()) > most and _supports(n, offset, points[near], box):
            heights = points[near] @ n - offset
            best, best_near, most = SupportPlane(n, offset, float(heights.abs().median())), near, int(near.sum())
    return best, best_near


def _near(points: Tensor, normals: Tensor, n: Tensor, offset: float, box: OrientedBox) -> Tensor:
    return ((points @ n - offset).abs() <= _THICKNESS * box.diagonal) & (normals @ n >= _FACING)


def _fitted(points: Tensor, n: Tensor) -> tuple[Tensor, float]:
    """The plane of least squares, its normal on the side of ``n``."""
    middle = points.mean(0)
    thinnest = torch.linalg.eigh((points - middle).T @ (points - middle))[1][:, 0]
    thinnest = thinnest * torch.sign(thinnest @ n)
    return thinnest, float(thinnest @ middle)


def _supports(n: Tensor, offset: float, on_plane: Tensor, box: OrientedBox) -> bool:
    """Whether the box stands before the plane and reaches it, and the plane goes on round the box's footprint."""
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
