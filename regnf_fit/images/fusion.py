"""A map fused from depth images, with what they have seen of it: in seconds, where :mod:`.fit` takes minutes.

The distances are truncated, averaged over the images (Curless and Levoy 1996) and kept in blocks of voxels near
surfaces alone. Where depths are good, such a map holds fine parts better than a network that is fitted to them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file

from regnf_core.errors import DatasetError, InvalidOptionsError
from regnf_core.fields.build import open_field
from regnf_core.schema.safe_format import read_description, write_safe_field
from regnf_data.fusing import BlockGrid, DepthImages, Progress, fuse_blocks
from regnf_data.posed_images import PosedImages
from regnf_fit.images.cells import cells_of
from regnf_fit.images.measured import ends_of, measured_rays, sharp_width
from regnf_fit.images.observing import attach_observation
from regnf_fit.images.preparation import PreparedImages, prepare
from regnf_fit.images.rays import PixelRays

_TRUNCATION = 4.0
"""Voxels, at least."""
_SPREADS = 3.0
"""Truncations, at least, in standard deviations of one image's depths from another's."""
_BLOCK, _MOST_BLOCKS = 8.0, 20_000
"""Voxels along a block's edge, and blocks with measured points at most: voxels that nobody gave grow beyond."""
_REFUSED = 10
"""Voxels so many times smaller than a pixel are refused, and so many times the blocks: they would take gigabytes."""
_GROWTH = 1.1
_CHECKED = 20_000


@dataclass(frozen=True)
class FusionOptions:
    """How images are fused. Lengths in field units.

    voxel: from node to node; None: as wide as a pixel of the sharper images is at its surface, or as many blocks allow
    · truncation: voxels; None: 4, or 3 standard deviations of the depths from image to image · observation_voxels:
    along the longest side of the grid of what was observed.
    """

    voxel: float | None = None
    truncation: float | None = None
    observation_voxels: int = 192


@dataclass(frozen=True)
class FusionReport:
    """What was made. voxel, truncation: field units · depth_error_median: of the map's distance at measured points,
    field units."""

    images: int
    voxel: float
    truncation: float
    depth_error_median: float
    seconds: float


def fuse_images(
    images: PosedImages,
    output: Path,
    options: FusionOptions | None = None,
    progress: Progress | None = None,
    label: str | None = None,
    source: dict[str, Any] | None = None,
) -> FusionReport:
    """Fuse ``images`` within their bounds to a map in ``output``, a safe field in the images' world frame.

    Raises DatasetError as a fit does, DATASET_DEPTH_MISSING for images without depths; InvalidOptionsError for voxels
    that are too small for the surface that was measured.
    """
    options = options or FusionOptions()
    started = time.monotonic()
    if images.depths is None:
        raise DatasetError("images without depths cannot be fused", reason="DATASET_DEPTH_MISSING")
    prepared = prepare(images, "auto", np.random.default_rng(0))
    rays = measured_rays(prepared)
    grid = _grid(prepared, rays, options)
    depths = _within(images, images.depths, grid.voxel * grid.truncation)
    fused = DepthImages(depths, images.intrinsics, images.T_world_camera, images.colors)
    rough = output.with_name(f"{output.stem}.part.safetensors")
    try:
        fuse_blocks(fused, grid, rough, progress)
        attach_observation(rough, replace(images, depths=depths), options.observation_voxels)
        _describe(rough, label, source or {})
        error = _error(rough, rays)
        rough.replace(output)
    finally:
        rough.unlink(missing_ok=True)
    return FusionReport(
        images=len(images),
        voxel=grid.voxel,
        truncation=grid.voxel * grid.truncation,
        depth_error_median=error,
        seconds=time.monotonic() - started,
    )


def _grid(prepared: PreparedImages, rays: PixelRays, options: FusionOptions) -> BlockGrid:
    voxel, ends = options.voxel or sharp_width(prepared, rays), ends_of(rays)
    while (blocks := len(cells_of(ends, _BLOCK * voxel).counts)) > _MOST_BLOCKS and options.voxel is None:
        voxel *= _GROWTH
    width = sharp_width(prepared, rays)
    if voxel < width / _REFUSED or blocks > _REFUSED * _MOST_BLOCKS:
        raise InvalidOptionsError(f"voxels of {voxel:.3g} are too small for pixels that are {width:.3g} wide there")
    truncation = options.truncation
    if truncation is None:
        spread = float(np.median(prepared.spread.at(rays.depths.numpy())))
        truncation = max(_TRUNCATION, _SPREADS * spread / voxel)
    return BlockGrid(voxel, truncation, float(rays.depths.max()))


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


def _describe(path: Path, label: str | None, source: dict[str, Any]) -> None:
    description = read_description(path)
    write_safe_field(path, {**description, "label": label, "source": source}, load_file(path))


def _error(path: Path, rays: PixelRays) -> float:
    """Median distance of the map at points that were measured."""
    chosen = torch.linspace(0, len(rays) - 1, min(len(rays), _CHECKED)).long()
    return float(open_field(path).signed_distance(ends_of(rays.take(chosen))).abs().median())
