"""Signed distances near the measured surface, from the map that all depths fuse to (:mod:`.measured_map`).

A ray tells the distance along itself, with its own noise; the map has the mean of all rays that pass a place. Its
places are drawn evenly over the surface, so that near surfaces and far ones count alike.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.fields.build import open_field
from regnf_data.posed_images import PosedImages
from regnf_fit.images.cells import cells_of
from regnf_fit.images.detail import in_boxes, uneven
from regnf_fit.images.measured import ends_of, measured_rays
from regnf_fit.images.measured_map import MapSize, map_grid, write_map
from regnf_fit.images.preparation import PreparedImages

_POOL = 2_000_000
_ON_SURFACE = 0.25
"""The share of the places that lie where a depth ended; the others lie up to ``_REACH`` beside it, along each axis."""
_REACH = 0.75
"""Truncations: what is farther from the map's surface is left out."""
_AT_ONCE = 1 << 17


@dataclass(frozen=True)
class MapDistances:
    """points: (P, 3), field units · distances: (P,) there · detailed: (D,) indices of those at detail."""

    points: Tensor
    distances: Tensor
    detailed: Tensor

    def to(self, device: torch.device) -> MapDistances:
        """The same on another device."""
        return MapDistances(self.points.to(device), self.distances.to(device), self.detailed.to(device))


def map_distances(images: PosedImages, prepared: PreparedImages, rng: np.random.Generator) -> MapDistances:
    """Fuse ``images``, which have depths, without the pixels held out, and draw places near their surface."""
    assert images.depths is not None
    rays = measured_rays(prepared)
    grid = map_grid(prepared, rays, MapSize())
    depths = images.depths.copy()
    depths.reshape(-1)[prepared.held_out_pixels] = 0.0
    ends = ends_of(rays)
    cells = cells_of(ends, grid.voxel)
    is_detailed = torch.zeros(len(cells.counts), dtype=torch.bool)
    is_detailed[cells.of[in_boxes(prepared.boxes, ends) | uneven(ends, rays.deviations, prepared.size)]] = True
    chosen = torch.from_numpy(rng.integers(len(cells.counts), size=_POOL))
    reach = _REACH * grid.truncation * grid.voxel
    beside = reach * (2.0 * rng.random((_POOL, 3), np.float32) - 1.0)
    beside[rng.random(_POOL) < _ON_SURFACE] = 0.0
    points = cells.means(ends).float()[chosen] + torch.from_numpy(beside)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.safetensors"
        write_map(replace(images, depths=depths), grid, path, colors=False)
        distances = _distances(open_field(path), points)
    near = distances.abs() < reach
    return MapDistances(points[near], distances[near], is_detailed[chosen[near]].nonzero()[:, 0])


def _distances(field: SdfField, points: Tensor) -> Tensor:
    return torch.cat([field.signed_distance(part) for part in torch.split(points, _AT_ONCE)])
