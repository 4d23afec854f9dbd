"""How far whole bundles of neighboring rays are free: one evaluation of the field for many rays.

A ball of radius D round the point at length t of a bundle's middle ray is free of surfaces. All its rays have the same
origin, and at length t none is farther from the middle one than t times the largest chord between their unit
directions. So all of them are free up to the length t + D - t chord. Where that is no more worth a step, the bundle is
divided into four. (Cone marching: Bastos and Celes 2012 for height fields; Hart 1996 for the balls.)
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.rendering.tracing import PLAIN_SHARE, Region, Start
from regnf_core.surface.cameras import Rays

_EDGES = (16, 8, 4, 2)
"""Pixels along the sides of a bundle."""
_WORTH = 0.5
"""Least step, as a share of the bundle's half width: shorter ones are left to smaller bundles."""
_MOST_STEPS = 128
_FEW = 16
"""As soon as no more than one bundle of so many goes on, the others' parts are gone on with: a call of the field for
a few points takes as long as for many."""
_LEAPS = 2.0
"""Length, in shortest steps, by which a bundle is moved on at once where it leaves matter."""


@dataclass(frozen=True)
class _Bundles:
    """G bundles of rays with one origin.

    of: (N,), each ray's bundle · origin: (3,) · direction: (G, 3) unit, the middle · chord: (G,), the largest from the
    middle's direction to a ray's.
    """

    of: Tensor
    origin: Tensor
    direction: Tensor
    chord: Tensor

    @classmethod
    def over(cls, rays: Rays, rows: Tensor, columns: Tensor, edge: int) -> _Bundles:
        """Squares of ``edge`` pixels. rows, columns: (N,) int64, of each ray's pixel."""
        wide = int(columns.max()) // edge + 1
        _, of = torch.unique((rows // edge) * wide + columns // edge, return_inverse=True)
        count = int(of.max()) + 1
        total = rays.directions.new_zeros(count, 3).index_add_(0, of, rays.directions)
        direction = torch.nn.functional.normalize(total, dim=-1)
        chord = (rays.directions - direction[of]).norm(dim=-1)
        return cls(of, rays.origins[0], direction, _reduced(chord, of, count, "amax"))

    def points(self, index: Tensor, t: Tensor) -> Tensor:
        """(M, 3) at lengths t (M,) of the middles of the bundles ``index`` (M,)."""
        return self.origin + t[:, None] * self.direction[index]


def free_start(region: Region, rays: Rays, rows: Tensor, columns: Tensor, margin: float = 0.0) -> Start:
    """Lengths along rays of one origin up to which they are free, or in matter where they begin in matter.

    rows, columns: (N,) int64, of each ray's pixel · margin: distance that is kept to a surface.
    """
    length, free = region.entry.clone(), torch.zeros_like(region.entry, dtype=torch.bool)
    live = (region.exit > region.entry).nonzero().squeeze(-1)
    for edge in _EDGES:
        if live.numel() == 0:
            break
        part = Rays(rays.origins[live], rays.directions[live])
        bundles = _Bundles.over(part, rows[live], columns[live], edge)
        length[live], free[live] = _follow(region, bundles, length[live], region.exit[live], free[live], margin)
        live = live[length[live] < region.exit[live]]
    return Start(length, free)


def _follow(
    region: Region, bundles: _Bundles, begin: Tensor, end: Tensor, free: Tensor, margin: float
) -> tuple[Tensor, Tensor]:
    """Where each ray (N,) stands once its bundle can go no farther, and whether it is free there."""
    count = len(bundles.chord)
    far, near = (_reduced(begin, bundles.of, count, how) for how in ("amax", "amin"))
    last = _reduced(end, bundles.of, count, "amax")
    some_free = _reduced(free.to(begin), bundles.of, count, "amax") > 0
    reached, is_free, moved = far.clone(), some_free.clone(), torch.zeros_like(some_free)
    leapt = torch.zeros_like(some_free)
    index = torch.arange(count, device=begin.device)
    t, behind = far.clone(), far - near  # a ball has to reach back to the ray that is farthest behind
    for _ in range(_MOST_STEPS):
        if index.numel() * _FEW <= count:
            break
        width = t * bundles.chord[index]
        distance = region.clamped_distance(bundles.points(index, t))
        step = PLAIN_SHARE * distance.abs() - width - margin
        out = distance > 0
        goes = (step > behind) & (step > _WORTH * width) & (step > region.shortest) & (out | ~is_free[index])
        at = index[goes]
        reached[at], moved[at] = (t + step)[goes], True
        is_free[at] |= out[goes]
        leaps = ~goes & ~is_free[index] & ~leapt[index] & moved[index]
        leapt[index[leaps]] = True
        t = torch.where(goes, t + step, t + _LEAPS * region.shortest)
        on = (goes | leaps) & (t < last[index])
        index, t = index[on], t[on]
        behind = torch.zeros_like(t)
    advanced = moved[bundles.of]
    length = torch.where(advanced, torch.maximum(begin, reached[bundles.of]), begin)
    return length, torch.where(advanced, is_free[bundles.of], free)


def _reduced(values: Tensor, of: Tensor, count: int, how: str) -> Tensor:
    """(count,): the largest or least of the values (N,) of each bundle."""
    return values.new_zeros(count).scatter_reduce_(0, of, values, how, include_self=False)
