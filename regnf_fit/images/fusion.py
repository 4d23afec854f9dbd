"""A map fused from depth images, with what they have seen of it: in seconds, where :mod:`.fit` takes minutes.

Where depths are good, such a map holds fine parts better than a network that is fitted to them.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load_file
from torch import Tensor

from regnf_core.errors import DatasetError, InvalidOptionsError
from regnf_core.fields.build import open_field
from regnf_core.importing.fusing import BlockGrid, Progress
from regnf_core.schema.safe_format import read_description, write_safe_field
from regnf_data.fusing import fuse_blocks
from regnf_data.posed_images import PosedImages
from regnf_fit.images.checks import check_bounds
from regnf_fit.images.observing import attach_observation
from regnf_fit.images.preparation import (
    PixelRays,
    PreparedImages,
    cells_of,
    ends_of,
    in_boxes,
    measured_within,
    on_device,
    prepare,
    uneven,
)
from regnf_fit.local_frame import LocalFrame

# The surface that depth images measured, and how wide their pixels are at it.

_SHARP = 0.25
"""The share of the pixels that are no wider at their surface than :func:`sharp_width`."""


def measured_rays(prepared: PreparedImages) -> PixelRays:
    """The training rays whose depth lies within the bounds."""
    return prepared.training.take(measured_within(prepared.training))


def sharp_width(prepared: PreparedImages, rays: PixelRays) -> float:
    """The width of a pixel of the sharper images at its surface, field units; of at least one ray."""
    return prepared.pixel * float(np.quantile(rays.depths.numpy(), _SHARP))


# The map of truncated distances that posed depth images fuse to: how wide its voxels are, and what is fused.
#
# The distances are averaged over the images (Curless and Levoy 1996) and kept in blocks of voxels near surfaces
# alone.

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
class FusionOptions:
    """How images are fused. voxel: from node to node, field units; None: as wide as a pixel of the sharper images is at
    its surface, or as noise and many blocks allow · truncation: voxels; None: 4, or 6 standard deviations of the depths
    from image to image · observation_voxels: along the longest side of the grid of what was observed."""

    voxel: float | None = None
    truncation: float | None = None
    observation_voxels: int = 192


def map_grid(prepared: PreparedImages, rays: PixelRays, size: FusionOptions) -> BlockGrid:
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
    """Write the regnf field file that ``images``, which have depths, fuse to within their bounds; the images as fused.

    colors: whether the map has colors.
    """
    assert images.depths is not None
    margin = grid.voxel * grid.truncation  # depths that end farther outside of the bounds are left out
    low, high = images.bounds[0] - margin, images.bounds[1] + margin
    ends = (images.ends(image) for image in range(len(images)))
    within = np.stack([((places >= low) & (places <= high)).all(axis=-1) for places in ends])
    depths = np.where(within & images.measured, images.depths, np.float32(0.0))
    shown = images.colors if colors else None
    fuse_blocks(depths, images.intrinsics, images.T_world_camera, grid, path, shown, progress)
    return replace(images, depths=depths)


_CHECKED = 20_000


@dataclass(frozen=True)
class FusionReport:
    """What was made. voxel, truncation: field units · depth_error_median: of the map's distance at measured points,
    field units · warnings: each begins with a stable word."""

    images: int
    voxel: float
    truncation: float
    depth_error_median: float
    seconds: float
    warnings: tuple[str, ...]


def fuse_images(
    images: PosedImages,
    output: Path,
    options: FusionOptions | None = None,
    progress: Progress | None = None,
    label: str | None = None,
    source: dict[str, Any] | None = None,
) -> FusionReport:
    """Fuse ``images`` within their bounds to a map in ``output``, a regnf field file in the images' world frame.

    Raises DatasetError as a fit does, DATASET_DEPTH_MISSING for images without depths; InvalidOptionsError for voxels
    that are too small for the surface that was measured.
    """
    options = options or FusionOptions()
    started = time.monotonic()
    if images.depths is None:
        raise DatasetError("images without depths cannot be fused", reason="DATASET_DEPTH_MISSING")
    check_bounds(images.bounds)
    frame = LocalFrame.near_origin(images.bounds)
    given, images = images, frame.enter(images)
    prepared = prepare(images, "auto", np.random.default_rng(0), given)
    rays = measured_rays(prepared)
    grid = map_grid(prepared, rays, options)
    rough = output.with_name(f"{output.stem}.part.safetensors")
    try:
        fused = write_map(images, grid, rough, progress)
        attach_observation(rough, fused, options.observation_voxels, prepared.spread)  # ``fused`` is too little of them
        chosen = torch.linspace(0, len(rays) - 1, min(len(rays), _CHECKED)).long()
        error = float(open_field(rough).signed_distance(ends_of(rays.take(chosen))).abs().median())
        description = frame.leave({**read_description(rough), "label": label, "source": source or {}})
        write_safe_field(rough, description, load_file(rough))
        rough.replace(output)
    finally:
        rough.unlink(missing_ok=True)
    return FusionReport(
        images=len(images),
        voxel=grid.voxel,
        truncation=grid.voxel * grid.truncation,
        depth_error_median=error,
        seconds=time.monotonic() - started,
        warnings=prepared.warnings,
    )


# Signed distances near the measured surface, from the map that all depths fuse to.
#
# A ray tells the distance along itself, with its own noise; the map has the mean of all rays that pass a place. Its
# places are drawn evenly over the surface, so that near surfaces and far ones count alike.

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
        return on_device(self, device)


def map_distances(images: PosedImages, prepared: PreparedImages, rng: np.random.Generator) -> MapDistances:
    """Fuse ``images``, which have depths, without the pixels held out, and draw places near their surface."""
    assert images.depths is not None
    rays = measured_rays(prepared)
    grid = map_grid(prepared, rays, FusionOptions())
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
        field = open_field(path)
        distances = torch.cat([field.signed_distance(part) for part in torch.split(points, _AT_ONCE)])
    near = distances.abs() < reach
    return MapDistances(points[near], distances[near], is_detailed[chosen[near]].nonzero()[:, 0])
