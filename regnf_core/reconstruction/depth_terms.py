"""What measured depths say about the signed distance.

Near the measured surface the distance along the ray and free space before it, as Azinovic et al. (2022, "Neural RGB-D
Surface Reconstruction") have it, with two changes for a field that shall be a distance, not one along a ray: the
distance along the ray is shortened by the cosine between ray and surface, and free points are given their distance to
the nearest measured surface (as Ortiz et al. 2022, "iSDF") in place of the truncation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from regnf_core.fields.neus_facto import NeusFactoFunction
from regnf_core.reconstruction.options import ReconstructionOptions
from regnf_core.reconstruction.rays import PixelRays

_FREE_POOL = 400_000
_VOXEL = 0.008
"""Diagonals: measured points closer together than this are averaged before distances to them are taken."""
_MORE_MATTER = 0.3
"""The same behind a surface, when a point is less deep than the ray says: the part may be thin."""
_PLACES_BEHIND = 0.25
"""The share of the points beside a surface that lie behind it."""


@dataclass(frozen=True)
class DepthSupervision:
    """What is drawn from in every iteration.

    rays: (R,) those with depth · free_points: (P, 3), free by what was seen · clearances: (P,) their distance to the
    nearest measured surface, field units · size: the bounds' diagonal.
    """

    rays: PixelRays
    free_points: Tensor
    clearances: Tensor
    size: float

    def to(self, device: torch.device) -> DepthSupervision:
        """The same on another device."""
        moved = self.free_points.to(device), self.clearances.to(device)
        return DepthSupervision(self.rays.to(device), *moved, self.size)


def supervise(
    rays: PixelRays, size: float, options: ReconstructionOptions, rng: np.random.Generator
) -> DepthSupervision:
    """The pool of rays with depth whose surface lies in the bounds, and of points known to be free."""
    seen = (rays.depths > 0.0) & ~rays.background
    inside = seen & (rays.depths >= rays.near) & (rays.depths <= rays.far)
    surface = rays.take(inside)
    cloud = _averaged(surface.at(surface.depths[:, None])[:, 0].numpy(), _VOXEL * size)
    speed = rays.directions.norm(dim=1)
    free_to = torch.where(seen, torch.minimum(rays.depths - options.band * size / speed, rays.far), rays.far)
    open_rays = rays.take((seen | rays.background) & (free_to > rays.near))
    free_to = free_to[(seen | rays.background) & (free_to > rays.near)]
    chosen = torch.from_numpy(rng.integers(len(open_rays), size=_FREE_POOL if len(open_rays) else 0))
    share = torch.from_numpy(rng.random(len(chosen), np.float32))
    picked = open_rays.take(chosen)
    points = picked.at((picked.near + share * (free_to[chosen] - picked.near))[:, None])[:, 0]
    clearances = cKDTree(cloud).query(points.numpy())[0]
    return DepthSupervision(surface, points, torch.from_numpy(clearances.astype(np.float32)), size)


def depth_terms(
    function: NeusFactoFunction, data: DepthSupervision, options: ReconstructionOptions, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """The surface's term and that of free space, in diagonals, and the points (N, 3) on and near the surface."""
    rays = data.rays.take(_draw(len(data.rays), options.surface_rays, generator, data.free_points.device))
    offsets = _offsets(len(rays), options, data.size, generator).to(rays.origins.device)  # (R, B), towards the camera
    cosines = torch.where(rays.cosines > 0.0, rays.cosines, 1.0)
    depths = rays.depths[:, None] - offsets / rays.directions.norm(dim=1, keepdim=True)
    near = rays.at(depths)  # (R, B, 3)
    free = _draw(len(data.free_points), options.free_points, generator, data.free_points.device)
    values = function.value(torch.cat((near.flatten(0, 1), data.free_points[free])))
    beside, beyond = values[: near.shape[0] * near.shape[1]].view_as(offsets), values[-len(free) :]
    error = beside - offsets * cosines[:, None]
    weight = torch.where((offsets < 0.0) & (error > 0.0), _MORE_MATTER, 1.0)
    # where no plane could be laid, only the surface itself is believed
    weight = torch.where((rays.cosines[:, None] <= 0.0) & (offsets != 0.0), 0.0, weight)
    surface = (weight * error.abs()).mean() / data.size
    free_space = (beyond - data.clearances[free]).abs().mean() / data.size
    return surface, free_space, near.flatten(0, 1)


def _offsets(rays: int, options: ReconstructionOptions, size: float, generator: torch.Generator) -> Tensor:
    """(R, 1 + B): 0 for the surface itself, then distances along the ray before it (positive) and behind."""
    share = torch.rand(rays, options.band_samples, generator=generator)
    behind = torch.rand(rays, options.band_samples, generator=generator) < _PLACES_BEHIND
    beside = torch.where(behind, -options.band_behind * share, options.band * share) * size
    return torch.cat((torch.zeros(rays, 1), beside), dim=1)


def _draw(pool: int, count: int, generator: torch.Generator, device: torch.device) -> Tensor:
    return torch.randint(pool, (count if pool else 0,), generator=generator).to(device)


def _averaged(points: NDArray[np.float32], voxel: float) -> NDArray[np.float64]:
    """One point (V, 3) for each occupied voxel: the mean of those within."""
    cells = np.floor(points.astype(np.float64) / voxel).astype(np.int64)
    _, index, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(index.ravel(), points[:, axis]) for axis in range(3)], axis=1)
    return np.asarray(sums / counts[:, None])
