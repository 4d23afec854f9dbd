"""Sphere tracing: where rays first meet a field's surface.

Each step evaluates only the rays that have neither arrived nor left. A neural field is not an exact distance. So the
steps are a little shorter than the distance, up to the first change of sign; then the zero between the last two points
is refined.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.errors import InvalidInputError, NoSurfaceError
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox, ray_box_interval
from regnf_core.geometry.bundle import Bundle
from regnf_core.surface.result_clouds import newton_step

# Virtual cameras that look at a box from above, and the grid of rays each of them casts.

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
MOST_RAYS_AT_ONCE = 1 << 18
"""Rays that are cast and followed together: bounds memory, at about 60 MB."""
_AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class Rays(Bundle):
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
        cast = []
        for view in range(first // per_edge**2, -(-last // per_edge**2)):
            before = view * per_edge**2
            pixels = torch.arange(max(first - before, 0), min(last - before, per_edge**2))
            cast.append(_cast_from(positions[view], target, corners, per_edge, pixels))
        yield Rays.cat(cast)


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


_STEP_SHARE = 0.9  # of the distance to the surface: neural fields overstate it a little in places
_MIN_STEPS_ACROSS = 1000  # the shortest step, as a fraction of the region's diagonal: thinner sheets may be missed
_MAX_MARCH_STEPS = 400
_REFINEMENTS = 8
_POINTS_AT_ONCE = 1 << 18
"""Bounds memory. A multiple of how many points fields evaluate at once: the same points make up each evaluation."""


@dataclass(frozen=True)
class Hits:
    """Where rays first meet the surface: points (M, 3) float32, the indices (M,) int64 of their rays, and the step
    (M,) int64 of the march that crossed the surface. Ordered by step, then by ray."""

    points: Tensor
    rays: Tensor
    steps: Tensor


def points_in_order(parts: Sequence[Hits]) -> Tensor:
    """The points (M, 3) of rays that were followed in parts, in the order as if all had been followed together."""
    order = torch.cat([part.steps for part in parts]).argsort(stable=True)
    return torch.cat([part.points for part in parts])[order]


def clip_to_region(rays: Rays, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Entry (>= 0) and exit (N,) of every ray into the axis-aligned region low..high (3,); exit < entry: missed."""
    return ray_box_interval(rays.origins, rays.directions, low.to(rays.origins), high.to(rays.origins))


def finite_distance(field: SdfField, points: Tensor) -> Tensor:
    """Signed distance (N,) at points (N, 3). Raises InvalidInputError (FIELD_NOT_FINITE) for NaN or infinity."""
    distance = field.signed_distance(points)
    require_finite(distance)
    return distance.to(points)


def require_finite(distance: Tensor) -> None:
    """Raises InvalidInputError (FIELD_NOT_FINITE) for NaN or infinity."""
    if not torch.isfinite(distance).all():
        raise InvalidInputError("the field evaluates to NaN or infinity", reason="FIELD_NOT_FINITE")


def first_hits(field: SdfField, rays: Rays, entry: Tensor, exit_: Tensor, min_step: float, tolerance: float) -> Hits:
    """The first zero crossing from free space into matter on every ray between ``entry`` and ``exit_`` (N,).

    Rays that start inside matter are dropped: their first crossing would be a back face. Rays whose zero is not found
    to ``tolerance`` (field units) are dropped too: there the field jumps, and has no surface.
    """
    steps, index, near, far, s_near, s_far = _march(field, rays, entry, exit_, min_step)
    t, s = _refine_zero(field, rays, index, near, far, s_near, s_far)
    kept = s.abs() <= tolerance
    index, t = index[kept], t[kept]
    return Hits(rays.origins[index] + t.unsqueeze(-1) * rays.directions[index], index, steps[kept])


def _distance_along(field: SdfField, rays: Rays, index: Tensor, t: Tensor) -> Tensor:
    """Signed distance (N,) on the rays with these numbers (N,), at ``t`` (N,) along each."""
    parts = zip(torch.split(index, _POINTS_AT_ONCE), torch.split(t, _POINTS_AT_ONCE), strict=True)
    found = [finite_distance(field, rays.origins[i] + along.unsqueeze(-1) * rays.directions[i]) for i, along in parts]
    return found[0] if len(found) == 1 else torch.cat(found)


def _march(
    field: SdfField, rays: Rays, entry: Tensor, exit_: Tensor, min_step: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Step until the sign changes. Numbers of the steps and of the rays, then distances along the ray and field values
    before and behind it."""
    index = (exit_ > entry).nonzero().squeeze(-1)
    t = entry[index]
    s = _distance_along(field, rays, index, t)
    outside = s > 0
    index, t, s = index[outside], t[outside], s[outside]
    found: list[tuple[Tensor, ...]] = []
    for step in range(_MAX_MARCH_STEPS):
        if index.numel() == 0:
            break
        ahead = t + (_STEP_SHARE * s).clamp_min(min_step)
        s_ahead = _distance_along(field, rays, index, ahead)
        crossed = s_ahead <= 0
        steps = torch.full_like(index[crossed], step)
        found.append((steps, index[crossed], t[crossed], ahead[crossed], s[crossed], s_ahead[crossed]))
        continuing = ~crossed & (ahead < exit_[index])
        index, t, s = index[continuing], ahead[continuing], s_ahead[continuing]
    if not found:
        empty = torch.empty(0, device=rays.origins.device)
        return index, index, empty, empty, empty, empty
    steps, index, near, far, s_near, s_far = (torch.cat(parts) for parts in zip(*found, strict=True))
    return steps, index, near, far, s_near, s_far


def _refine_zero(
    field: SdfField, rays: Rays, index: Tensor, near: Tensor, far: Tensor, s_near: Tensor, s_far: Tensor
) -> tuple[Tensor, Tensor]:
    """The best point and its field value between near (outside) and far (inside): secant steps, kept in the bracket.

    The Illinois rule halves the value at an end that has not moved, so that both ends converge.
    """
    best_t, best_s = near.clone(), s_near.clone()
    last_side = torch.zeros_like(index)
    for _ in range(_REFINEMENTS):
        if index.numel() == 0:
            break
        t = near + (far - near) * (s_near / (s_near - s_far).clamp_min(1e-30)).clamp(0.02, 0.98)
        s = _distance_along(field, rays, index, t)
        better = s.abs() < best_s.abs()
        best_t, best_s = torch.where(better, t, best_t), torch.where(better, s, best_s)
        out = s > 0
        s_far = torch.where(out & (last_side == 1), s_far / 2, s_far)
        s_near = torch.where(~out & (last_side == -1), s_near / 2, s_near)
        near, s_near = torch.where(out, t, near), torch.where(out, s, s_near)
        far, s_far = torch.where(out, far, t), torch.where(out, s_far, s)
        last_side = torch.where(out, 1, -1)
    return best_t, best_s


def shortest_step(diagonal: float) -> float:
    """The shortest step of a march through a region with this diagonal."""
    return diagonal / _MIN_STEPS_ACROSS


def free_lengths(field: SdfField, rays: Rays, entry: Tensor, exit_: Tensor, min_step: float) -> tuple[Tensor, Tensor]:
    """How far every ray is free from its origin, (N,), and whether it ends at a surface there, (N,) bool.

    0 for rays that start in matter and for those that miss the region; the exit where nothing is met. A ray that is
    followed for too many steps is free as far as it came. The surface is where a line through the last two values is
    zero: exact enough for voxels.
    """
    index = (exit_ > entry).nonzero().squeeze(-1)
    free, meets = torch.zeros_like(entry), torch.zeros_like(entry, dtype=torch.bool)
    t = entry[index]
    s = _distance_along(field, rays, index, t)
    index, t, s = index[s > 0], t[s > 0], s[s > 0]
    for _ in range(_MAX_MARCH_STEPS):
        if index.numel() == 0:
            break
        ahead = t + (_STEP_SHARE * s).clamp_min(min_step)
        s_ahead = _distance_along(field, rays, index, ahead)
        crossed, leaves = s_ahead <= 0, ahead >= exit_[index]
        zero = t + (ahead - t) * (s / (s - s_ahead).clamp_min(1e-30))
        free[index] = torch.where(crossed, zero, torch.minimum(ahead, exit_[index]))
        meets[index] = crossed & (zero <= exit_[index])
        index, t, s = (part[~crossed & ~leaves] for part in (index, ahead, s_ahead))
    return free, meets


# The bounding box of an object's surface: the bounds of a field are often much larger than the object.

_GRID = 32  # cells along the longest edge; 32,768 evaluations at most
_MARGIN = 0.02


def surface_bounds(field: SdfField) -> OrientedBox:
    """The axis-aligned box of the field's zero level, field frame.

    Evaluates a grid of cell centers. One Newton step projects the centers of cells that may hold surface onto it.
    Raises NoSurfaceError (NO_SURFACE_IN_OBJECT) when no cell does, InvalidInputError (FIELD_NOT_FINITE).
    """
    low, high = field.bounds
    cell = float((high - low).max()) / _GRID
    counts = ((high - low) / cell).ceil().clamp_min(1).long().tolist()
    axes = [
        low[k] + (torch.arange(count, dtype=torch.float64) + 0.5) * (high[k] - low[k]) / count
        for k, count in enumerate(counts)
    ]
    centers = torch.cartesian_prod(*axes).to(field.device)
    near = finite_distance(field, centers).abs() <= 0.5 * 3**0.5 * cell
    if not near.any():
        raise NoSurfaceError("the object's field has no surface within its bounds", reason="NO_SURFACE_IN_OBJECT")
    distance, gradient = field.signed_distance_and_gradient(centers[near])
    surface = (centers[near] - newton_step(distance, gradient).to(centers)).double().cpu()
    lowest, highest = torch.maximum(surface.amin(0), low), torch.minimum(surface.amax(0), high)
    center, size = (lowest + highest) / 2, (highest - lowest).clamp_min(cell)
    return OrientedBox(center, size * (1.0 + _MARGIN), torch.eye(3, dtype=torch.float64))
