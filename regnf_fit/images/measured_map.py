"""The map of truncated distances that posed depth images fuse to: how wide its voxels are, and what is fused.

The distances are averaged over the images (Curless and Levoy 1996) and kept in blocks of voxels near surfaces alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import InvalidOptionsError
from regnf_data.fusing import BlockGrid, DepthImages, Progress, fuse_blocks
from regnf_data.posed_images import PosedImages
from regnf_fit.images.cells import cells_of
from regnf_fit.images.measured import ends_of, sharp_width
from regnf_fit.images.preparation import PreparedImages
from regnf_fit.images.rays import PixelRays

_TRUNCATION = 4.0
"""Voxels, at least."""
_SPREADS = 6.0
"""Truncations, at least, in standard deviations of one image's depths from another's, measured across the surface.
Depths are left out of voxels farther than a truncation behind them: where it is narrow, those that were read too near
are left out and those read too far are not, so that surfaces recede; where it is wide, thin parts swell."""
_LEAST_SPREADS = 0.5
"""Voxels, at least, in these deviations: smaller ones say no more, and the truncation would have many."""
_BLOCK, _MOST_BLOCKS = 8.0, 20_000
"""Voxels along a block's edge, and blocks with measured points at most: voxels that nobody gave grow beyond."""
_REFUSED = 10
"""Voxels so many times smaller than a pixel are refused, and so many times the blocks: they would take gigabytes."""
_GROWTH = 1.1


@dataclass(frozen=True)
class MapSize:
    """voxel: from node to node, field units; None: as wide as a pixel of the sharper images is at its surface, or as
    noise and many blocks allow · truncation: voxels; None: 4, or 6 standard deviations of the depths from image to
    image."""

    voxel: float | None = None
    truncation: float | None = None


def map_grid(prepared: PreparedImages, rays: PixelRays, size: MapSize) -> BlockGrid:
    """The voxels of a map. rays: those that were measured, at least one.

    Raises InvalidOptionsError for voxels that are too small for the surface that was measured.
    """
    width, ends = sharp_width(prepared, rays), ends_of(rays)
    spread = prepared.spread.median(rays.depths.numpy())
    voxel = size.voxel or max(width, _LEAST_SPREADS * spread)
    while (blocks := len(cells_of(ends, _BLOCK * voxel).counts)) > _MOST_BLOCKS and size.voxel is None:
        voxel *= _GROWTH
    if voxel < width / _REFUSED or blocks > _REFUSED * _MOST_BLOCKS:
        raise InvalidOptionsError(f"voxels of {voxel:.3g} are too small for pixels that are {width:.3g} wide there")
    truncation = size.truncation or max(_TRUNCATION, _SPREADS * spread / voxel)
    return BlockGrid(voxel, truncation, float(rays.depths.max()))


def write_map(
    images: PosedImages, grid: BlockGrid, path: Path, progress: Progress | None = None, colors: bool = True
) -> PosedImages:
    """Write the safe field that ``images``, which have depths, fuse to within their bounds; the images as fused.

    colors: whether the map has colors.
    """
    assert images.depths is not None
    depths = _within(images, images.depths, grid.voxel * grid.truncation)
    fused = DepthImages(depths, images.intrinsics, images.T_world_camera, images.colors if colors else None)
    fuse_blocks(fused, grid, path, progress)
    return replace(images, depths=depths)


def _within(images: PosedImages, depths: NDArray[np.float32], margin: float) -> NDArray[np.float32]:
    """The depths, 0 where they end farther than ``margin`` outside the bounds, or a mask says background."""
    height, width = images.size
    places = np.stack([*np.indices((height, width))[::-1] + 0.5, np.ones((height, width))], axis=-1)
    low, high = images.bounds[0] - margin, images.bounds[1] + margin
    kept = np.zeros_like(depths)
    for number, (depth, K, pose) in enumerate(zip(depths, images.intrinsics, images.T_world_camera, strict=True)):
        ends = (depth[..., None] * (places @ np.linalg.inv(K).T)) @ pose[:3, :3].T + pose[:3, 3]
        kept[number] = np.where(((ends >= low) & (ends <= high)).all(axis=-1), depth, 0.0)
    return kept if images.masks is None else np.where(images.masks, kept, np.float32(0.0))
