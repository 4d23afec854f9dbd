"""Support planes: floors, walls and table tops. All other surface in the region stands in front of them.

A detection box also holds a part of what the object stands on or leans against. Such a plane differs from the object's
own faces, and which way is up need not be known: all other surface is in front of the plane, while behind an object's
own face there is the rest of the object. Rough fields have bumpy floors with loose surface beneath. There, planes are
fitted to the smoothed surface, they are as thick as it is rough, and the rougher it is, the more surface may lie behind
them. A plane never takes more than a small part of the detection box's height above it: what lies flat on a table is
thinner than the errors of a rough table.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.robust.constants import SUPPORT_PLANES
from regnf_core.robust.samples import Samples
from regnf_core.robust.scene.smoothing import SmoothedSurface, smooth


def support_planes(
    samples: Samples, generator: torch.Generator, edges: Tensor | None = None, outside: Tensor | None = None
) -> Tensor:
    """(N,) bool: which samples lie on a support plane, or behind it. Points in working units, box diagonal 1.

    edges: (3, 3), a row for each edge of the detection box; None: planes are as thick as they need be · outside: (N,)
    bool, samples outside of the detection box; where given, only planes that go on there are support planes. This is
    for scenes that were observed in part: behind an object's faces there is no surface either.
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
        found = _best_plane(surface[rest], generator, edges, None if outside is None else outside[rest])
        if found is None:
            break
        on_support[rest[found]] = True
    return on_support


def _best_plane(
    surface: SmoothedSurface, generator: torch.Generator, edges: Tensor | None, outside: Tensor | None
) -> Tensor | None:
    """(N,) bool: points on and behind the support plane with the most points, or with the most of those outside; None
    when there is none."""
    c = SUPPORT_PLANES
    basis = surface if outside is None else surface[outside.nonzero().squeeze(-1)]
    if len(basis.points) < c.min_points:
        return None
    points, normals = surface.points, surface.normals
    rough = _rough(surface)
    planes = _planes(basis, generator, fitted=rough > 0.0 or outside is not None)
    thickness = _thickness(surface, planes, edges)
    heights = points @ planes.normals.T - planes.heights
    facing = normals @ planes.normals.T
    on_plane = (heights.abs() <= thickness) & (facing >= c.min_normal_cosine)
    behind = heights < -c.behind * thickness
    counts = _count_support(on_plane, behind, facing, rough)
    order = counts
    if outside is not None:
        beyond = (on_plane & outside[:, None]).sum(0)
        counts[beyond < c.min_share_outside * counts] = 0
        order = beyond.where(counts > 0, 0)
    best = int(order.argmax())
    if counts[best] < c.min_share * len(points):
        return None
    near = heights[:, best] <= c.removed_thickness * thickness[best]
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


@dataclass(frozen=True, eq=False)
class _Planes:
    """K planes: unit normals (K, 3) and heights (K,) above the origin."""

    normals: Tensor
    heights: Tensor


def _planes(surface: SmoothedSurface, generator: torch.Generator, fitted: bool) -> _Planes:
    """Planes through samples of the surface. fitted: again by least squares, to the samples near them."""
    c = SUPPORT_PLANES
    points, normals = surface.points, surface.normals
    picks = torch.randperm(len(points), generator=generator)[: c.candidates]
    n, middles = normals[picks], points[picks]
    squares = (points[:, :, None] * points[:, None, :]).reshape(-1, 9)
    for _ in range(c.fit_rounds if fitted else 0):
        heights = points @ n.T - (middles * n).sum(-1)
        near = (heights.abs() <= c.fit_thickness * _max_thickness(surface)) & (normals @ n.T >= c.fit_min_normal_cosine)
        weights = near.to(points).T  # (K, N)
        total = weights.sum(1, keepdim=True).clamp_min(1.0)
        middle = weights @ points / total
        spread = (weights @ squares / total).reshape(-1, 3, 3) - middle[:, :, None] * middle[:, None, :]
        thinnest = torch.linalg.eigh(spread.double())[1][:, :, 0].to(n)
        enough = total >= c.min_points
        n = torch.where(enough, thinnest * torch.sign((thinnest * n).sum(-1, keepdim=True)), n)
        middles = torch.where(enough, middle, middles)
    return _Planes(n, (middles * n).sum(-1))


def _max_thickness(surface: SmoothedSurface) -> float:
    """Half the thickness of a plane of such roughness, whatever stands on it."""
    c = SUPPORT_PLANES
    return min(max(c.thickness, c.thickness_per_roughness * surface.roughness), c.max_thickness)


def _thickness(surface: SmoothedSurface, planes: _Planes, edges: Tensor | None) -> Tensor:
    """(K,): half the thickness of each plane."""
    most = torch.full_like(planes.heights, _max_thickness(surface))
    if edges is None:
        return most
    heights = (planes.normals @ edges.to(planes.normals).T).abs().sum(-1)
    return most.minimum(SUPPORT_PLANES.max_share_of_height * heights)
