"""Virtual cameras that look at a box from above, and the grid of rays each of them casts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class Rays:
    """Rays of all cameras together: origins (N, 3), unit directions (N, 3), float32, field frame."""

    origins: Tensor
    directions: Tensor


def axis_vector(axis: str) -> Tensor:
    """The unit vector (3,) float64 of "x", "y" or "z"."""
    vector = torch.zeros(3, dtype=torch.float64)
    vector[_AXES[axis]] = 1.0
    return vector


def camera_positions(center: Tensor, distance: float, views: int, up_axis: str, turn: float = 0.0) -> Tensor:
    """(views, 3) positions on the upper half of a sphere around ``center`` (3,), spread by the golden angle.

    Heights run from near the pole to near the horizon in equal steps, which gives every camera the same area of the
    half sphere. ``turn`` (radians) rotates all of them about the vertical: another turn, other views.
    """
    index = torch.arange(views, dtype=torch.float64)
    height = 1.0 - (index + 0.5) / views
    azimuth = index * _GOLDEN_ANGLE + turn
    radius = (1.0 - height**2).sqrt()
    up = _AXES[up_axis]
    positions = torch.empty(views, 3, dtype=torch.float64)
    positions[:, up] = height
    positions[:, (up + 1) % 3] = radius * azimuth.cos()
    positions[:, (up + 2) % 3] = radius * azimuth.sin()
    return center.to(torch.float64) + distance * positions


def cast_rays(positions: Tensor, target: Tensor, corners: Tensor, image_size: int, pixel_stride: int) -> Rays:
    """The rays of square images at ``positions`` (V, 3) that look at ``target`` (3,).

    Every ``pixel_stride``-th pixel along both axes of an ``image_size`` image, as the paper does. The field of view is
    the narrowest square one that holds all ``corners`` (8, 3), so that no rays are spent on the rest of the room.
    """
    per_edge = max(1, image_size // pixel_stride)
    grid = (torch.arange(per_edge, dtype=torch.float64) + 0.5) / per_edge * 2.0 - 1.0  # pixel centers in (-1, 1)
    v, u = torch.meshgrid(grid, grid, indexing="ij")
    origins, directions = [], []
    for position in positions:
        right, down, forward = _look_at(position, target)
        tangent = _half_view_tangent(corners - position, right, down, forward)
        rays = forward + tangent * (u.reshape(-1, 1) * right + v.reshape(-1, 1) * down)  # (P, 3)
        directions.append(rays / rays.norm(dim=-1, keepdim=True))
        origins.append(position.expand_as(rays))
    return Rays(torch.cat(origins).float(), torch.cat(directions).float())


def _look_at(position: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit vectors right, down and forward of a camera; any roll will do for a grid of rays."""
    forward = torch.nn.functional.normalize(target.to(position) - position, dim=0)
    helper = torch.zeros(3, dtype=position.dtype)
    helper[int(forward.abs().argmin())] = 1.0
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, helper), dim=0)
    return right, torch.linalg.cross(forward, right), forward


def _half_view_tangent(offsets: Tensor, right: Tensor, down: Tensor, forward: Tensor) -> float:
    """Tangent of the half field of view that holds all offsets (8, 3) from the camera; at most that of 80 degrees."""
    widest = math.tan(math.radians(80.0))
    depth = offsets @ forward
    if bool((depth <= 1e-6).any()):
        return widest
    sideways = torch.stack([offsets @ right, offsets @ down]).abs().amax(0)
    return min(widest, float((sideways / depth).max()))
