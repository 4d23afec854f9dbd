"""Surfaces that are only seen: depths drawn from cameras, fused to a map of truncated distances with weights."""

from __future__ import annotations

import io
import os
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.families.converted import ConvertedField, observed_field
from regnf_core.importing.families.layers import entries_at
from regnf_core.importing.families.voxel_block_grid import convert as convert_blocks
from regnf_core.importing.fusing import BlockGrid, fused_arrays
from regnf_core.importing.splats.gaussians import Doubles
from regnf_core.importing.splats.views import Region, Seen, Trained
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.description import FREE, SURFACE, UNSEEN, ObservationGrid
from regnf_core.schema.kinds import WEIGHTS
from regnf_core.schema.similarity import shift_rows

VOXELS = 256
"""Along the longest edge of the region."""
_TRUNCATION = 4.0
"""Voxels."""
_BEYOND = 2.0
"""Voxels beyond the region's box in which depths still count."""
_SLAB = 8
"""Layers of the observation's cells at once: they stay in the processor's cache."""
_FILLED_AT_ONCE = 4096
"""Blocks: memory."""
_ACROSS, _LOOK_THROUGH = 2.0, 2
"""Voxels along an edge of the observation's; views that must look through one for it to be free."""


def fused_field(
    views: list[Seen],
    region: Region,
    alone: bool,
    overrides: UploadDescription,
    tensor_bytes: int,
    near: tuple[float, float, float] | None = None,
    voxels: int = VOXELS,
) -> ConvertedField:
    """The field of what views see of a region, with its observation. alone: as of ``agreed``; what no view sees is
    matter then · near: what was subtracted from the file's coordinates · voxels: along the region's longest edge.

    Raises FieldFormatError: NO_ZERO_LEVEL where no camera sees a surface.
    """
    scale, shift = overrides.world_scale or 1.0, np.array(near or (0.0, 0.0, 0.0))
    voxel = region.longest / voxels
    views = [_cropped(view, region, voxel) for view in views]
    bounds = None if overrides.bounds is None else (np.array(overrides.bounds) - scale * shift).tolist()
    said = UploadDescription(
        bounds=bounds,
        world_scale=overrides.world_scale,
        sign=overrides.sign,
        up_axis=overrides.up_axis,
        label=overrides.label,
        color=overrides.color,
    )
    fused = _fused(views, voxel, replace(said, truncation=_TRUNCATION * voxel), tensor_bytes)
    grid, words = _observation(views, region, voxel, alone)
    if alone:
        fused = _filled(fused, grid, words)
    description = fused.description
    if near is not None:
        entries = {name: description[name] for name in ("bounds", "world_scale")}
        entries["bounds"] = [(np.array(corner) + scale * shift).tolist() for corner in entries["bounds"]]
        description = {**description, **entries_at(entries, near)}
    found = replace(fused, description=description)
    return observed_field(found, grid, words, f"in depths of {len(views)} views")


def workers() -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    return max(1, min(cores, int(os.environ.get("OMP_NUM_THREADS") or cores)))


def into_file(overrides: UploadDescription, cameras: Trained, shift: Doubles) -> Doubles:
    """(4, 4), from the shifted Gaussians to the frame of the cameras: the dataset's where its transform is known."""
    known = np.eye(4) if overrides.dataset_transform is None else np.array(overrides.dataset_transform)
    back = np.array(shift_rows(shift.tolist()))
    T = known @ back if cameras.T_dataset_file is None else np.linalg.inv(cameras.T_dataset_file) @ known @ back
    return np.asarray(T)


def _cropped(view: Seen, region: Region, voxel: float) -> Seen:
    """Without depths that end outside of the region."""
    ends = view.ends()
    low, high = region.low - _BEYOND * voxel, region.high + _BEYOND * voxel
    inside = ((ends >= low) & (ends <= high)).all(axis=-1)
    return replace(view, depth=np.where(inside | np.isnan(view.depth), view.depth, np.float32(0.0)))


def _fused(views: list[Seen], voxel: float, said: UploadDescription, tensor_bytes: int) -> ConvertedField:
    """Raises FieldFormatError (NO_ZERO_LEVEL)."""
    poses: list[Doubles] = [np.linalg.inv(view.camera.T_camera_world).astype(np.float64) for view in views]
    depths = [np.ascontiguousarray(np.nan_to_num(view.depth), np.float32) for view in views]
    farthest = max((float(depth.max(initial=0.0)) for depth in depths), default=0.0)
    grid = BlockGrid(voxel, _TRUNCATION, 1.01 * farthest)
    colors = [view.color for view in views if view.color is not None] or None
    arrays = fused_arrays(depths, [view.camera.matrix for view in views], poses, grid, colors)
    if arrays is None:
        message = "no view sees a surface: less than half of the light is stopped everywhere"
        raise FieldFormatError(message, reason="NO_ZERO_LEVEL")
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    found = convert_blocks(ArraySource(file.getbuffer(), tensor_bytes), said)
    if found is None:
        raise RuntimeError("the fused map is not read as one")
    return found


def _observation(
    views: list[Seen], region: Region, voxel: float, alone: bool
) -> tuple[ObservationGrid, npt.NDArray[np.int32]]:
    """What the views saw of the region: surface where a depth ends, free where several look through. alone: as of
    ``agreed``."""
    edge = _ACROSS * voxel
    counts = np.maximum(np.ceil((region.high - region.low) / edge), 1).astype(np.int64)
    axes = [low + edge * (np.arange(count) + 0.5) for low, count in zip(region.low, counts, strict=True)]
    through, ends = np.zeros(counts, np.uint8), np.zeros(counts, np.bool_)
    for view in views:
        for first in range(0, counts[0], _SLAB):
            part = slice(first, first + _SLAB)
            ahead = view.ahead(axes[0][part], axes[1], axes[2])
            ends[part] |= np.abs(ahead) <= edge
            through[part] += (ahead > edge) & (alone | (ahead < np.inf))
    states = np.where(ends, SURFACE, np.where(through >= _LOOK_THROUGH, FREE, UNSEEN)).astype(np.uint8)
    x, y, z = (int(count) for count in counts)
    low = tuple(float(value) for value in region.low)
    grid = ObservationGrid((low[0], low[1], low[2]), float(edge), (x, y, z))
    return grid, grid.pack(states)


def _filled(fused: ConvertedField, grid: ObservationGrid, words: npt.NDArray[np.int32]) -> ConvertedField:
    """The map with matter where no view of the object looks, to which the fusion has no distances."""
    tensors, size = dict(fused.tensors), float(fused.description["voxel_size"])
    blocks, values = np.asarray(tensors["blocks"], np.int32), np.asarray(tensors["values"], np.float32)
    weights, matter = np.asarray(tensors[WEIGHTS], np.float16), np.float32(-_TRUNCATION * size)
    edge, hidden = values.shape[1], grid.unpack(words) == UNSEEN
    middle, low = np.array(grid.low) + grid.voxel / 2, np.floor(np.array(grid.low) / (edge * size)).astype(np.int32)
    reached = np.zeros(np.ceil(np.array(grid.counts) * grid.voxel / (edge * size)).astype(int) + 1, np.bool_)
    reached[tuple((np.floor((np.argwhere(hidden) * grid.voxel + middle) / (edge * size)).astype(np.int32) - low).T)] = 1
    known = blocks - low
    known = known[((known >= 0) & (known < reached.shape)).all(axis=1)]
    reached[tuple(known.T)] = False
    more = (np.argwhere(reached) + low).astype(np.int32)
    added = (len(more), edge, edge, edge)
    tensors["blocks"] = blocks = np.concatenate([blocks, more])
    tensors[WEIGHTS] = weights = np.concatenate([weights, np.zeros(added, weights.dtype)])
    tensors["values"] = values = np.concatenate([values, np.full(added, -matter, values.dtype)])
    inner = np.indices((edge, edge, edge)).reshape(3, -1).T
    for start in range(0, len(blocks), _FILLED_AT_ONCE):
        part = slice(start, start + _FILLED_AT_ONCE)
        nodes = size * (edge * blocks[part, None] + inner)
        cells = np.floor((nodes - np.array(grid.low)) / grid.voxel).astype(np.int32)
        within = ((cells >= 0) & (cells < grid.counts)).all(axis=-1)
        inside = within & hidden[tuple(np.where(within[..., None], cells, 0).transpose(2, 0, 1))]
        values[part][inside.reshape(values[part].shape) & (weights[part] == 0)] = matter
    if "color.values" in tensors:
        colors = np.asarray(tensors["color.values"], np.float16)
        tensors["color.values"] = np.concatenate([colors, np.full((*added, 3), -1.0, colors.dtype)])
    return replace(fused, tensors=tensors)
