"""Virtual cameras that look at a box from above, and the grid of rays each of them casts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
MOST_RAYS_AT_ONCE = 1 << 18
"""Rays that are cast and followed together: bounds memory, at about 60 MB."""
_AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class Rays:
    """Rays of one or several cameras: origins (N, 3), unit directions (N, 3), float32, field frame."""

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


def cast_rays(
    positions: Tensor,
    target: Tensor,
    corners: Tensor,
    image_size: int,
    pixel_stride: int,
    most: int = MOST_RAYS_AT_ONCE,
) -> Iterator[Rays]:
    """The rays of square images at ``positions`` (V, 3) that look at ``target`` (3,), in parts of ``most`` or fewer.

    Every ``pixel_stride``-th pixel along both axes of an ``image_size`` image, as the paper does. The field of view is
    the narrowest square one that holds all ``corners`` (8, 3), so that no rays are spent on the rest of the room. All
    parts together are the same rays in the same order, however many parts there are.
    """
    per_edge = max(1, image_size // pixel_stride)
    total = len(positions) * per_edge**2
    parts = -(-total // most)  # of about equal size: a part of a few rays would be rounded otherwise than a large one
    for part in range(parts):
        first, last = total * part // parts, total * (part + 1) // parts
        origins, directions = [], []
        for view in range(first // per_edge**2, -(-last // per_edge**2)):
            before = view * per_edge**2
            pixels = torch.arange(max(first - before, 0), min(last - before, per_edge**2))
            one = _cast_from(positions[view], target, corners, per_edge, pixels)
            origins.append(one.origins)
            directions.append(one.directions)
        yield Rays(torch.cat(origins), torch.cat(directions))


def _cast_from(position: Tensor, target: Tensor, corners: Tensor, per_edge: int, pixels: Tensor) -> Rays:
    """The rays of some pixels (P,) of one image, numbered row by row."""
    grid = (torch.arange(per_edge, dtype=torch.float64) + 0.5) / per_edge * 2.0 - 1.0  # pixel centers in (-1, 1)
    right, down, forward = _look_at(position, target)
    tangent = _half_view_tangent(corners - position, right, down, forward)
    u, v = grid[pixels % per_edge, None], grid[pixels // per_edge, None]
    rays = forward + tangent * (u * right + v * down)  # (P, 3)
    return Rays(position.expand_as(rays).float(), (rays / rays.norm(dim=-1, keepdim=True)).float())


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
