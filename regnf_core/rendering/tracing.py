"""Where rays first meet a surface, with few evaluations of the field.

Sphere tracing (Hart 1996) with automatic relaxation (Balint and Valasek 2018): the last two distances tell how fast a
ray approaches; the step is as long as lets the spheres around its two ends just touch if that goes on. Where they turn
out not to touch, something may have been passed, and the ray goes back and takes the plain step.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.observation import SdfField
from regnf_core.surface.sphere_tracing import Rays, clip_to_region, finite_distance, shortest_step

# How far a ray may go without asking the field: lower bounds of the distance in the cells of a grid.
#
# Cells near the surface are halved, and those too far from it for their size are not: the field is asked at few
# places. It takes the part of an occupancy grid, and says of empty cells how empty they are.

_COARSEST, _LEVELS = 16, 3
"""Cells along the longest edge, and how often they are halved: 64 at the end."""
_TRUSTED = 0.85
"""Share of a distance that is believed: neural fields overstate distances far from surfaces."""
_LEAST = 0.2
"""Of a cell's edge: smaller bounds save no step."""
_AT_ONCE = 1 << 17


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """low: (3,), the bounds' lowest corner · cell: edge · bound: (X, Y, Z), never above the distance to a surface
    anywhere in the cell, 0 where one may be in it, and in matter."""

    low: Tensor
    cell: float
    bound: Tensor

    @classmethod
    def of(cls, field: SdfField) -> DistanceGrid:
        """On the field's device. Raises InvalidInputError (FIELD_NOT_FINITE)."""
        low, high = (corner.float().to(field.device) for corner in field.bounds)
        coarse = float((high - low).max()) / _COARSEST
        counts = torch.ceil((high - low) / coarse - 1e-6).long().clamp_min(1)
        size = [int(n) << (_LEVELS - 1) for n in counts.tolist()]
        bound = torch.zeros(size, device=low.device)
        cells = torch.cartesian_prod(*(torch.arange(int(n), device=low.device) for n in counts))
        for level in range(_LEVELS):
            cell, parts = coarse / (1 << level), 1 << (_LEVELS - 1 - level)
            distance = torch.cat(
                [finite_distance(field, low + cell * (part + 0.5)) for part in torch.split(cells, _AT_ONCE)]
            )
            free = distance * _TRUSTED > 0.5 * 3**0.5 * cell
            within = torch.cartesian_prod(*(torch.arange(parts, device=low.device),) * 3)
            # from the cell's middle to the farthest corner of each finest cell
            offset = ((within + 0.5) / parts - 0.5).abs() + 0.5 / parts
            found = (distance[free, None] * _TRUSTED - cell * offset.norm(dim=-1)).reshape(-1)
            x, y, z = (cells[free, None] * parts + within).reshape(-1, 3).unbind(-1)
            bound[x, y, z] = torch.where(found >= _LEAST * cell / parts, found, 0.0)
            near = distance.abs() * _TRUSTED <= 0.5 * 3**0.5 * cell
            children = torch.cartesian_prod(*(torch.arange(2, device=low.device),) * 3)
            cells = (2 * cells[near, None] + children).reshape(-1, 3)
        return cls(low, coarse / (1 << (_LEVELS - 1)), bound)

    def at(self, points: Tensor) -> Tensor:
        """(N,): the bound at points (N, 3); 0 outside of the grid."""
        index = ((points - self.low) / self.cell).floor().long()
        size = torch.tensor(self.bound.shape, device=points.device)
        within = ((index >= 0) & (index < size)).all(-1)
        x, y, z = index.clamp_min(0).minimum(size - 1).unbind(-1)
        return torch.where(within, self.bound[x, y, z], 0.0)


PLAIN_SHARE = 0.9
"""Of the distance, in a plain step: neural fields overstate it a little in places."""
_LEAST_APPROACH = 0.1
"""Least change of the distance along a ray, per length, that the end of its way is told by."""
_MOST_STEPS = 512
_SECANT_STEPS = 5


@dataclass(frozen=True)
class Region:
    """What rays are followed through.

    field, grid: what is asked · low, high: (3,), its bounds · entry, exit: (N,), lengths along each ray · shortest: the
    shortest step · tolerance: distance below which a surface is reached.
    """

    field: SdfField
    grid: DistanceGrid
    low: Tensor
    high: Tensor
    entry: Tensor
    exit: Tensor
    shortest: float
    tolerance: float

    @classmethod
    def along(cls, rays: Rays, field: SdfField, grid: DistanceGrid, tolerance: float) -> Region:
        """All that rays may see of a field: within its bounds. tolerance: of their diagonal."""
        low, high = (corner.float().to(field.device) for corner in field.bounds)
        diagonal = float((high - low).norm())
        entry, exit_ = clip_to_region(rays, low, high)
        return cls(field, grid, low, high, entry, exit_, shortest_step(diagonal), tolerance * diagonal)

    def distance(self, points: Tensor) -> Tensor:
        """(N,) at points (N, 3): the grid's bound where there is one, else the field's value."""
        distance = self.grid.at(points)
        asked = (distance <= 0.0).nonzero().squeeze(-1)
        distance[asked] = finite_distance(self.field, points[asked])
        return distance

    def clamped_distance(self, points: Tensor) -> Tensor:
        """(N,) at points (N, 3) that may lie outside of the bounds: no more than to what is within."""
        inside = torch.minimum(torch.maximum(points, self.low), self.high)
        nearest: Tensor = self.distance(inside) - (points - inside).norm(dim=-1)
        return nearest


@dataclass(frozen=True)
class Start:
    """Where rays begin. length: (N,), nothing is seen before it · free: (N,), whether it is known to be free there."""

    length: Tensor
    free: Tensor


def trace(region: Region, rays: Rays, start: Start) -> Tensor:
    """(N,): the length along each ray of its first zero crossing from free space into matter; inf where there is none.

    Rays that begin in matter count from where they leave it. A length is good to about ``tolerance``.
    """
    index = (region.exit > start.length).nonzero().squeeze(-1)
    found = torch.full_like(region.entry, torch.inf)
    t = start.length[index]
    step = torch.zeros_like(t)
    # the distance before the last step; 0: not in free space yet
    before = torch.where(start.free[index], region.tolerance, 0.0)
    brackets: list[tuple[Tensor, ...]] = []
    for _ in range(_MOST_STEPS):
        if index.numel() == 0:
            break
        s = region.distance(rays.origins[index] + t[:, None] * rays.directions[index])
        was_free = before > 0
        missed = was_free & (s.abs() + before < step) & (step > PLAIN_SHARE * before) & (step > region.shortest)
        crossed = was_free & (s <= 0) & ~missed
        approach = torch.where(was_free & (step > 0), (before - s) / step.clamp_min(1e-12), 1.0).clamp(0.0, 1.0)
        # what is left along the ray counts: a ray that grazes the surface goes on for longer
        near = region.tolerance * approach.clamp_min(_LEAST_APPROACH)
        reached = (s > 0) & (s < near) & was_free & ~missed & (s < before)
        found[index[reached]] = t[reached]
        if crossed.any():
            here = (index, t - step, t, before, s)
            brackets.append(tuple(values[crossed] for values in here))
        onward = torch.where(s > 0, s * (PLAIN_SHARE * 2.0 / (1.0 + approach)), s.abs() * PLAIN_SHARE)
        onward = onward.clamp_min(region.shortest)
        plain = (PLAIN_SHARE * before).clamp_min(region.shortest)
        t = torch.where(missed, t - step + plain, t + onward)
        step = torch.where(missed, plain, onward)
        before = torch.where(missed, before, s.clamp_min(0.0))
        going = ~crossed & ~reached & (t - step < region.exit[index])
        index, t, step, before = index[going], t[going], step[going], before[going]
    if brackets:
        crossing, *ends = (torch.cat(values) for values in zip(*brackets, strict=True))
        found[crossing] = _refined(region, rays, crossing, *ends)
    return found


def _refined(
    region: Region, rays: Rays, index: Tensor, near: Tensor, far: Tensor, s_near: Tensor, s_far: Tensor
) -> Tensor:
    """(N,): the zero between near (outside) and far (inside), by secant steps kept in the bracket.

    Only those that are not good enough yet are asked again.
    """
    best, error = near.clone(), s_near.clone()
    slope = ((s_near - s_far) / (far - near).clamp_min(1e-12)).clamp(_LEAST_APPROACH, 1.0)
    enough = 0.5 * region.tolerance * slope
    for step in range(_SECANT_STEPS):
        left = (error.abs() > enough).nonzero().squeeze(-1)
        if left.numel() == 0:
            break
        a, b, s_a, s_b = near[left], far[left], s_near[left], s_far[left]
        share = (s_a / (s_a - s_b).clamp_min(1e-30)).clamp(0.02, 0.98)
        t = a + (b - a) * (share if step % 3 < 2 else torch.full_like(share, 0.5))
        s = finite_distance(region.field, rays.origins[index[left]] + t[:, None] * rays.directions[index[left]])
        best[left], error[left] = t, s
        out = s > 0
        near[left], s_near[left] = torch.where(out, t, a), torch.where(out, s, s_a)
        far[left], s_far[left] = torch.where(out, b, t), torch.where(out, s_b, s)
    return best
