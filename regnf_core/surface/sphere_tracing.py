"""Sphere tracing: where rays first meet a field's surface.

Each step evaluates only the rays that have neither arrived nor left. A neural field is not an exact distance. So the
steps are a little shorter than the distance, up to the first change of sign; then the zero between the last two points
is refined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.fields.base import SdfField
from regnf_core.geometry.ray_box import ray_box_interval
from regnf_core.surface.cameras import Rays

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
        raise InvalidInputError("the field gives values that are not finite", reason="FIELD_NOT_FINITE")


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
