"""How well a field agrees with pixels that it was not fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_fit.images.network import RadianceField
from regnf_fit.images.rays import PixelRays

_STEPS = 64
_CHUNK = 4096
_SHORTEST = 0.002
"""Diagonals: the least step; a field that is not an exact distance would otherwise be approached for ever."""
_BISECTIONS = 6


@dataclass(frozen=True)
class HeldOutErrors:
    """Depth errors: field units, of rays that met a surface, where a depth was measured, not before the bounds."""

    depth_error: float | None
    depth_error_median: float | None
    eikonal_error: float


@dataclass(frozen=True)
class FirstHits:
    """Of R rays: depths (R,) of the first surface, 0 where none was met · normals (R, 3), not of unit length."""

    depths: Tensor
    normals: Tensor


@torch.no_grad()
def first_hits(field: RadianceField, rays: PixelRays, size: float) -> FirstHits:
    """Where rays first enter matter: sphere tracing with a least step, then bisection."""
    parts = [_traced(field, rays.take(index), size) for index in _chunks(len(rays))]
    if not parts:
        empty = torch.zeros(0, 3)
        return FirstHits(empty[:, 0], empty)
    return FirstHits(*(torch.cat([getattr(p, name) for p in parts]) for name in ("depths", "normals")))


@torch.no_grad()
def evaluate(field: RadianceField, rays: PixelRays, size: float) -> HeldOutErrors:
    """The errors at held-out rays, but for those that something before the bounds ends: they show nothing of it."""
    occluded = (rays.depths > 0.0) & (rays.depths < rays.near)
    rays = rays.take(~rays.background & ~occluded)
    hits = first_hits(field, rays, size)
    met = hits.depths > 0.0
    both = met & (rays.depths > 0.0)
    depth_error = (hits.depths - rays.depths).abs()[both]
    norms = hits.normals[met].norm(dim=1)
    return HeldOutErrors(
        depth_error=float(depth_error.mean()) if both.any() else None,
        depth_error_median=float(depth_error.median()) if both.any() else None,
        eikonal_error=float((norms - 1.0).abs().mean()) if met.any() else 1.0,
    )


def _chunks(count: int) -> tuple[Tensor, ...]:
    return tuple(torch.arange(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK))


def _traced(field: RadianceField, rays: PixelRays, size: float) -> FirstHits:
    function = field.function()
    speed = rays.directions.norm(dim=1)
    before, depth = rays.near.clone(), rays.near.clone()
    inside = torch.zeros_like(depth, dtype=torch.bool)
    for _ in range(_STEPS):
        active = (~inside & (depth <= rays.far)).nonzero()[:, 0]
        if len(active) == 0:
            break
        moving = rays.take(active)
        distance = function.value(moving.at(depth[active, None])[:, 0])
        inside[active] = distance < 0.0
        on = active[distance >= 0.0]
        before[on] = depth[on]
        depth[on] += distance[distance >= 0.0].clamp_min(_SHORTEST * size) / speed[on]
    hit = inside & (depth > rays.near)
    low, high = before, depth
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2.0
        matter = function.value(rays.at(middle[:, None])[:, 0]) < 0.0
        low, high = torch.where(matter, low, middle), torch.where(matter, middle, high)
    points = rays.at(high[:, None])[:, 0]
    normals = function.value_and_gradient(points)[1]
    return FirstHits(torch.where(hit, high, 0.0), normals)
