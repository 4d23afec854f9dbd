"""Floors, walls and table tops: planes that everything else in the region stands in front of.

A detection box holds part of what the object stands on or leans against. Such a plane is told from the object's own
faces without knowing which way is up: its normal faces all the rest, whereas behind an object's own face there is the
rest of the object. Rough fields have bumpy floors, with crumbs beneath: planes are fitted to the smoothed surface, as
thick as it is rough, and the rougher it is the more may lie behind them.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from regnf_core.robust.residuals import Samples
from regnf_core.robust.scene.smoothing import Smoothed, smoothed

_CANDIDATES = 200
_THICKNESS = 0.012  # of the box's diagonal, or
_ROUGHNESSES = 2.5  # the surface's roughness so many times,
_THICKEST = 0.03  # but no more of the diagonal
_PARALLEL = 0.9  # least cosine between a plane's normal and those of its points
_FITTED_PARALLEL, _FITTED_THICKNESS = 0.8, 2.5  # the same, the thickness in that of the plane, of what it is fitted to
_FITS, _FEWEST = 2, 10  # how often, and least points of a plane that is fitted
_LEAST_SHARE = 0.06  # of all samples: fewer are no plane worth removing
_MOST_BEHIND = 0.04  # of all samples: more behind it, and it is no support
_ROUGH = (0.02, 0.06)  # incoherence of accurate fits, and of those stopped after 3 % of their training
_MOST_BEHIND_ROUGH = 0.7  # of the plane's own samples, where the surface is so rough
_BROAD = 0.15  # of the samples: only planes with more are forgiven their crumbs
_FAR_SIDE = (-0.9, -0.5)  # largest cosine of what is the far side of a floor, smooth and rough
_LEAST_OUTSIDE = 0.15  # of a plane's samples: a floor goes on beyond the detection box
_MOST_PLANES = 3


def support(samples: Samples, generator: torch.Generator, outside: Tensor | None = None) -> Tensor:
    """(N,) bool: which samples lie on a supporting plane, or behind it. Points in working units, box diagonal 1.

    outside: (N,) bool, samples beyond the detection box; where given, only planes that go on out there are supports.
    That is for scenes seen in part: there is nothing behind an object's faces there either.
    """
    on_support = torch.zeros(len(samples), dtype=torch.bool)
    if len(samples) == 0:
        return on_support
    surface = smoothed(samples)
    if _rough(surface) == 0.0:
        surface = replace(surface, points=samples.on_surface(), normals=samples.normals)
    for _ in range(_MOST_PLANES):
        rest = (~on_support).nonzero().squeeze(-1)
        if rest.numel() < 10:
            break
        found = _best_plane(surface[rest], generator, None if outside is None else outside[rest])
        if found is None:
            break
        on_support[rest[found]] = True
    return on_support


def _best_plane(surface: Smoothed, generator: torch.Generator, outside: Tensor | None) -> Tensor | None:
    """(N,) bool: points on and behind the most populated supporting plane; None when there is none."""
    points, normals = surface.points, surface.normals
    total = points.shape[0]
    thickness = min(max(_THICKNESS, _ROUGHNESSES * surface.roughness), _THICKEST)
    picks = torch.randperm(total, generator=generator)[:_CANDIDATES]
    rough = _rough(surface)
    if rough > 0.0:
        n, heights = _fitted(points, normals, points[picks], normals[picks], thickness)
    else:
        n = normals[picks]
        heights = points @ n.T - (points[picks] * n).sum(-1)
    facing = normals @ n.T
    on_plane = (heights.abs() <= thickness) & (facing >= _PARALLEL)
    behind = heights < -2 * thickness
    counts = on_plane.sum(0)
    # What faces the other way behind a plane is the far side of a floor or a wall, no argument against it.
    against = (behind & (facing > _FAR_SIDE[0] + rough * (_FAR_SIDE[1] - _FAR_SIDE[0]))).sum(0)
    crumbs = torch.where(counts > _BROAD * total, _MOST_BEHIND_ROUGH * rough * counts, 0.0)
    allowed = crumbs.clamp_min(_MOST_BEHIND * total)
    counts[against > allowed] = 0
    if outside is not None:
        counts[(on_plane & outside[:, None]).sum(0) < _LEAST_OUTSIDE * counts] = 0
    best = int(counts.argmax())
    if counts[best] < _LEAST_SHARE * total:
        return None
    return (heights[:, best] <= 1.5 * thickness) & ((facing[:, best] >= 0.5) | behind[:, best])


def _rough(surface: Smoothed) -> float:
    """0 for accurate fits, 1 for those stopped after 3 % of their training, or worse."""
    return min(max((surface.incoherence - _ROUGH[0]) / (_ROUGH[1] - _ROUGH[0]), 0.0), 1.0)


def _fitted(points: Tensor, normals: Tensor, middles: Tensor, n: Tensor, thickness: float) -> tuple[Tensor, Tensor]:
    """Normals (K, 3) of the planes through ``middles`` (K, 3) along ``n``, refitted to the points near them by least
    squares, and the heights (N, K) of all points above them."""
    squares = (points[:, :, None] * points[:, None, :]).reshape(-1, 9)
    for _ in range(_FITS):
        heights = points @ n.T - (middles * n).sum(-1)
        near = (heights.abs() <= _FITTED_THICKNESS * thickness) & (normals @ n.T >= _FITTED_PARALLEL)
        weights = near.to(points).T  # (K, N)
        total = weights.sum(1, keepdim=True).clamp_min(1.0)
        middle = weights @ points / total
        spread = (weights @ squares / total).reshape(-1, 3, 3) - middle[:, :, None] * middle[:, None, :]
        thinnest = torch.linalg.eigh(spread.double())[1][:, :, 0].to(n)
        enough = total.squeeze(1) >= _FEWEST
        n = torch.where(enough[:, None], thinnest * torch.sign((thinnest * n).sum(-1, keepdim=True)), n)
        middles = torch.where(enough[:, None], middle, middles)
    return n, points @ n.T - (middles * n).sum(-1)
