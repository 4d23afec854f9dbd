"""What posed depth images have seen of a volume."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file
from torch import Tensor
from torch.nn.functional import max_pool2d

from regnf_core.errors import DatasetError, InvalidOptionsError
from regnf_core.fields.base import SdfField
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import Observation
from regnf_core.schema.observation_grid import FREE, MAX_COUNT, OBSERVATION, SURFACE, UNSEEN
from regnf_core.schema.safe_format import read_description, write_safe_field
from regnf_data.posed_images import PosedImages
from regnf_fit.images.depth_normals import local_planes
from regnf_fit.images.depth_spread import NO_SPREAD, DepthSpread, depth_spread

_MARGIN = 1.0
"""Voxels before a measured surface that may be matter as well."""
_SPREADS = 3.0
"""The same in standard deviations of a depth, where the images contradict each other by more."""
_PIXELS = 1.2
"""Widths of a pixel that a voxel is across at least: narrower ones would fall between the pixels' rays."""
_AT_ONCE = 1 << 17
"""Voxels that are looked up in an image at once: what is in use stays in the processor's cache."""
_CHECKED, _NEAR, _AGREEING = 2000, 2.0, 0.6
"""So many voxels with surface are looked up in a field; this share of them must be within so many voxels of its own, or
within ``_SPREADS`` deviations of the depths."""


def observe(images: PosedImages, voxels: int, spread: DepthSpread = NO_SPREAD) -> Observation | None:
    """Carve the bounds (Kutulakos and Seitz 2000, "A Theory of Shape by Space Carving", with depths for colors): what
    a camera looked through is free, where a depth ends there is a surface, the rest is unobserved.

    voxels: along the longest side of the bounds; fewer where a pixel is wider than that. None without depths, or for 0.
    spread: of the depths from image to image; what is nearer to a measured surface than that is not seen to be free.
    A voxel is free where all four rays round its center, in some image, pass it by: at the edge of a thing one of them
    ends there. (The center's own pixel is not enough: voxels are about as wide as a pixel.)

    Raises InvalidOptionsError for more voxels than a safe field keeps.
    """
    if not 0 <= voxels <= MAX_COUNT:
        raise InvalidOptionsError(f"observation_voxels: {voxels} is not from 0 to {MAX_COUNT}")
    if images.depths is None or voxels == 0:
        return None
    low, high = torch.from_numpy(images.bounds)
    voxel = max(float((high - low).max()) / voxels, _PIXELS * _pixel_width(images))
    counts = [int(n) for n in ((high - low) / voxel - 1e-9).ceil().clamp_min(1)]
    states = torch.full(counts, UNSEEN, dtype=torch.uint8).view(-1)
    axes = [low[k] + (torch.arange(counts[k], dtype=torch.float64) + 0.5) * voxel for k in range(3)]
    centers = torch.cartesian_prod(*axes).float()
    left = list(torch.split(torch.arange(len(centers)), _AT_ONCE))
    for image in range(len(images)):
        margins = np.maximum(_SPREADS * spread.at(images.depths[image]), np.float32(_MARGIN * voxel))
        clear = _clear_depths(images, image, margins)
        for number, part in enumerate(left):
            free = _looked_through(centers[part], images, image, clear)
            states[part[free]] = FREE
            left[number] = part[~free]
    ends = torch.cat([_ends(images, image) for image in range(len(images))])
    cells = ((ends - low) / voxel).floor().long()
    x, y, z = cells[((cells >= 0) & (cells < torch.tensor(counts))).all(-1)].unbind(-1)
    states.view(counts)[x, y, z] = SURFACE
    return Observation(states.view(counts), low, voxel)


def _pixel_width(images: PosedImages) -> float:
    """The median width of a pixel where its depth ends; 0 where none does."""
    assert images.depths is not None
    widths = (images.depths / images.intrinsics[:, 0, 0, None, None])[images.depths > 0.0]
    return float(np.median(widths)) if widths.size else 0.0


def _clear_depths(images: PosedImages, image: int, margins: NDArray[np.float32]) -> Tensor:
    """(H + 1, W + 1): up to which depth all pixels at each corner of pixels were seen to be free; 0 where one of them
    shows nothing.

    margins: (H, W) before what was measured, along the camera's axis. The background is infinitely far.
    """
    assert images.depths is not None
    measured = images.depths[image]
    clear = np.where(measured > 0.0, measured - margins, np.float32(0.0))
    if images.masks is not None:
        clear = np.where(images.masks[image], clear, np.float32(np.inf))
    return -max_pool2d(torch.from_numpy(-clear)[None], kernel_size=2, stride=1, padding=1)[0]


def _looked_through(centers: Tensor, images: PosedImages, image: int, clear: Tensor) -> Tensor:
    """(N,) bool: which voxels with centers (N, 3) one image looked through. clear: of its pixels' corners, see
    ``_clear_depths``."""
    T_camera_world = np.linalg.inv(images.T_world_camera[image])
    projection = torch.from_numpy(images.intrinsics[image] @ T_camera_world[:3]).float()
    x, y, z = torch.addmm(projection[:, 3:], projection[:, :3], centers.T)
    depth = z.clamp_min(1e-6)
    column, row = x.div_(depth), y.div_(depth)
    height, width = images.size
    shown = (z > 1e-6) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = shown.nonzero()[:, 0]
    corner = (row[at] + 0.5).long(), (column[at] + 0.5).long()
    free = z[at] < clear[corner]
    return torch.zeros_like(shown).index_put((at,), free)


def _ends(images: PosedImages, image: int) -> Tensor:
    """(M, 3) float64 where one image's depths end, world frame; the background's are none."""
    assert images.depths is not None
    depths: NDArray[np.float32] = images.depths[image]
    row, column = np.nonzero(depths > 0.0 if images.masks is None else (depths > 0.0) & images.masks[image])
    z = depths[row, column].astype(np.float64)
    rays = np.stack([column + 0.5, row + 0.5, np.ones_like(z)], -1) @ np.linalg.inv(images.intrinsics[image]).T
    T = images.T_world_camera[image]
    return torch.from_numpy((rays * z[:, None]) @ T[:3, :3].T + T[:3, 3])


def attach_observation(
    path: Path, images: PosedImages, voxels: int = 192, spread: DepthSpread | None = None
) -> Observation:
    """Keep with the safe field in ``path`` what ``images`` of the same scene, in the field's frame, have seen.

    spread: of the depths from image to image; None: as these images show it, all of whose pixels it takes.
    Raises DatasetError: DATASET_DEPTH_MISSING, or DATASET_OF_ANOTHER_FRAME where the field has no surface where the
    images saw one; FieldFormatError as :func:`regnf_core.fields.build.open_field`.
    """
    if spread is None and images.depths is not None:
        spread = depth_spread(images, local_planes(images.depths, images.intrinsics).cosines)
    spread = spread or NO_SPREAD
    seen = observe(images, voxels, spread)
    if seen is None:
        raise DatasetError("an observation needs depths, and there are none", reason="DATASET_DEPTH_MISSING")
    assert images.depths is not None
    measured = images.depths[images.depths > 0.0]
    _check_frame(open_field(path), seen, _SPREADS * spread.median(measured) if len(measured) else 0.0)
    description = read_description(path)
    scale = float(description["world_scale"])
    grid, words = replace(seen, low=seen.low / scale, voxel=seen.voxel / scale).stored()
    tensors = {**load_file(path), OBSERVATION: words}
    write_safe_field(path, {**description, OBSERVATION: asdict(grid)}, tensors)
    return seen


def _check_frame(field: SdfField, seen: Observation, noise: float) -> None:
    """Raise DatasetError (DATASET_OF_ANOTHER_FRAME) unless the field's surface runs where one was measured.

    noise: how far from it depths may end, world units; many voxels in a small thing before a coarse sensor.
    """
    cells = (seen.states == SURFACE).nonzero()
    cells = cells[:: max(1, len(cells) // _CHECKED)]
    points = ((cells + 0.5) * seen.voxel + seen.low).float()
    distance = field.signed_distance(points.to(field.device)).abs().cpu()
    near = max(_NEAR * seen.voxel, noise)
    if len(cells) == 0 or not float((distance <= near).float().mean()) >= _AGREEING:
        raise DatasetError(
            "the field has no surface where the images saw one: are they of the same scene, in the same frame?",
            reason="DATASET_OF_ANOTHER_FRAME",
        )
