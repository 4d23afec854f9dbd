"""A map fused from depth images, with what they have seen of it: in seconds, where :mod:`.fit` takes minutes.

Where depths are good, such a map holds fine parts better than a network that is fitted to them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load_file

from regnf_core.errors import DatasetError
from regnf_core.fields.build import open_field
from regnf_core.schema.safe_format import read_description, write_safe_field
from regnf_data.fusing import Progress
from regnf_data.posed_images import PosedImages
from regnf_fit.images.checks import check_bounds
from regnf_fit.images.measured import ends_of, measured_rays
from regnf_fit.images.measured_map import MapSize, map_grid, write_map
from regnf_fit.images.observing import attach_observation
from regnf_fit.images.preparation import prepare
from regnf_fit.images.rays import PixelRays
from regnf_fit.local_frame import LocalFrame

_CHECKED = 20_000


@dataclass(frozen=True)
class FusionOptions(MapSize):
    """How images are fused. observation_voxels: along the longest side of the grid of what was observed."""

    observation_voxels: int = 192


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
    """Fuse ``images`` within their bounds to a map in ``output``, a safe field in the images' world frame.

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
        error = _error(rough, rays)
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


def _error(path: Path, rays: PixelRays) -> float:
    """Median distance of the map at points that were measured."""
    chosen = torch.linspace(0, len(rays) - 1, min(len(rays), _CHECKED)).long()
    return float(open_field(path).signed_distance(ends_of(rays.take(chosen))).abs().median())
