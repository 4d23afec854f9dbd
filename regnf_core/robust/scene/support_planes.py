"""Support planes: floors, walls and table tops. All other surface in the region stands in front of them.

A detection box also holds a part of what the object stands on or leans against. Such a plane differs from the object's
own faces, and which way is up need not be known: all other surface is in front of the plane, while behind an object's
own face there is the rest of the object. Rough fields have bumpy floors with loose surface beneath. There, planes are
fitted to the smoothed surface, they are as thick as it is rough, and the rougher it is, the more surface may lie behind
them.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from regnf_core.robust.constants import SUPPORT_PLANES
from regnf_core.robust.samples import Samples
from regnf_core.robust.scene.smoothing import SmoothedSurface, smooth


def support_planes(samples: Samples, generator: torch.Generator, outside: Tensor | None = None) -> Tensor:
    """(N,) bool: which samples lie on a support plane, or behind it. Points in working units, box diagonal 1.

    outside: (N,) bool, samples outside of the detection box; where given, only planes that go on there are support
    planes. This is for scenes that were observed in part: behind an object's faces there is no surface either.
    """
    on_support = torch.zeros(len(samples), dtype=torch.bool)
    if len(samples) == 0:
        return on_support
    surface = smooth(samples)
    if _rough(surface) == 0.0:
        surface = replace(surface, points=samples.on_surface(), normals=samples.normals)
    for _ in range(SUPPORT_PLANES.max_planes):
        rest = (~on_support).nonzero().squeeze(-1)
        if rest.numel() < SUPPORT_PLANES.min_points:
            break
        found = _best_plane(surface[rest], generator, None if outside is None else outside[rest])
        if found is None:
            break
        on_support[rest[found]] = True
    return on_support


def _best_plane(surface: SmoothedSurface, generator: torch.Generator, outside: Tensor | None) -> Tensor | None:
    """(N,) bool: points on and behind the support plane with the most points; None when there is none."""
    c = SUPPORT_PLANES
    points, normals = surface.points, surface.normals
    total = points.shape[0]
    thickness = min(max(c.thickness, c.thickness_per_roughness * surface.roughness), c.max_thickness)
    picks = torch.randperm(total, generator=generator)[: c.candidates]
    rough = _rough(surface)
    if rough > 0.0:
        n, heights = _fit_planes(points, normals, points[picks], normals[picks], thickness)
    else:
        n = normals[picks]
        heights = points @ n.T - (points[picks] * n).sum(-1)
    facing = normals @ n.T
    on_plane = (heights.abs() <= thickness) & (facing >= c.min_normal_cosine)
    behind = heights < -c.behind * thickness
    counts = _count_support(on_plane, behind, facing, rough)
    if outside is not None:
        counts[(on_plane & outside[:, None]).sum(0) < c.min_share_outside * counts] = 0
    best = int(counts.argmax())
    if counts[best] < c.min_share * total:
        return None
    near = heights[:, best] <= c.removed_thickness * thickness
    return near & ((facing[:, best] >= c.removed_min_cosine) | behind[:, best])


def _count_support(on_plane: Tensor, behind: Tensor, facing: Tensor, rough: float) -> Tensor:
    """(K,) samples on each plane, 0 where too much surface lies behind it. Arguments: (N, K) for N samples, K planes.

    facing: cosines between the normals of samples and planes · rough: 0..1.
    """
    c = SUPPORT_PLANES
    total, counts = on_plane.shape[0], on_plane.sum(0)
    # Surface behind a plane that faces the other way is the far side of a floor or a wall: it does not count.
    far_side = c.far_side_cosines[0] + rough * (c.far_side_cosines[1] - c.far_side_cosines[0])
    loose = torch.where(counts > c.broad_share * total, c.max_share_behind_rough * rough * counts, 0.0)
    counts[(behind & (facing > far_side)).sum(0) > loose.clamp_min(c.max_share_behind * total)] = 0
    return counts


def _rough(surface: SmoothedSurface) -> float:
    """0 for accurate fits, 1 for those stopped after 3 % of their training, or worse."""
    low, high = SUPPORT_PLANES.rough_range
    return min(max((surface.normal_roughness - low) / (high - low), 0.0), 1.0)


def _fit_planes(points: Tensor, normals: Tensor, middles: Tensor, n: Tensor, thickness: float) -> tuple[Tensor, Tensor]:
    """Normals (K, 3) of the planes through ``middles`` (K, 3) with normals ``n``, fitted again to the points near them
    by least squares, and the heights (N, K) of all points above them."""
    c = SUPPORT_PLANES
    squares = (points[:, :, None] * points[:, None, :]).reshape(-1, 9)
    for _ in range(c.fit_rounds):
        heights = points @ n.T - (middles * n).sum(-1)
        near = (heights.abs() <= c.fit_thickness * thickness) & (normals @ n.T >= c.fit_min_normal_cosine)
        weights = near.to(points).T  # (K, N)
        total = weights.sum(1, keepdim=True).clamp_min(1.0)
        middle = weights @ points / total
        spread = (weights @ squares / total).reshape(-1, 3, 3) - middle[:, :, None] * middle[:, None, :]
        thinnest = torch.linalg.eigh(spread.double())[1][:, :, 0].to(n)
        enough = total.squeeze(1) >= c.min_points
        n = torch.where(enough[:, None], thinnest * torch.sign((thinnest * n).sum(-1, keepdim=True)), n)
        middles = torch.where(enough[:, None], middle, middles)
    return n, points @ n.T - (middles * n).sum(-1)
