"""Gaussian splats as fields: depths that cameras see of them, fused to a map of truncated distances with weights.

The cameras are those of the training where they came with the file; else some are placed around an object, or in the
free space of a scene. Depths that other views contradict, as floaters have them, are left out, and so are those of
splats that are seen from behind.
"""

from __future__ import annotations

import io
import os
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.assumptions import GLTF, PLACES, RUB, UNIT, Assumptions
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.families.converted import ConvertedField, observed_field
from regnf_core.importing.families.layers import entries_at, refuse_other_entries, require_family
from regnf_core.importing.families.voxel_block_grid import convert as convert_blocks
from regnf_core.importing.fusing import BlockGrid, fused_arrays
from regnf_core.importing.meshes.scene import refuse_node
from regnf_core.importing.meshes.triangle_files import Siblings, malformed
from regnf_core.importing.splats.drawing import prepared
from regnf_core.importing.splats.gaussians import Doubles, Splats, sound
from regnf_core.importing.splats.packed import read_ksplat, read_splat, read_spz
from regnf_core.importing.splats.tables import read_gltf_splats, read_ply_splats, read_sog
from regnf_core.importing.splats.views import (
    Region,
    Seen,
    Trained,
    agreed,
    cameras_for,
    drawn,
    given_cameras,
    region_of,
    touching,
)
from regnf_core.importing.upload_description import CamerasDescription, UploadDescription
from regnf_core.schema.description import FREE, SURFACE, UNSEEN, ObservationGrid
from regnf_core.schema.kinds import WEIGHTS
from regnf_core.schema.similarity import local_origin, shift_rows

FAMILY = "gaussian_splats"
ASSUMPTIONS = {"spz": (UNIT, RUB), "sog": (UNIT, RUB), "glb": GLTF, "gltf": GLTF}
"""Of formats that define more than numbers."""
_VOXELS, _VOXELS_WITHIN = 256, 512
"""Along the longest edge of the region, of an object and of a scene, in which things are a part of it."""
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


def read_splats(format_: str, data: memoryview, siblings: Siblings, node: str | None = None) -> Splats:
    """The Gaussians of a file of the format that ``sniff_format`` named, as they are stored. node: of a glTF scene, the
    node to read.

    Raises FieldFormatError: MESH_INVALID, MESH_EXTERNAL_REFERENCE, FORMAT_NOT_SUPPORTED.
    """
    if format_ == "sog":
        refuse_node(node, format_)
        return read_sog(data, siblings)
    if format_ in ("glb", "gltf"):
        found = read_gltf_splats(data, siblings, node)
        if found is None:
            raise malformed("the glTF file has no Gaussians")
        return found
    refuse_node(node, format_)
    readers = {"splat-ply": read_ply_splats, "splat": read_splat, "ksplat": read_ksplat, "spz": read_spz}
    return readers[format_](data)


def convert_splats(
    splats: Splats,
    origin: str,
    overrides: UploadDescription,
    cameras: Trained | None,
    tensor_bytes: int,
    assumes: Assumptions = PLACES,
) -> ConvertedField:
    """The field of Gaussians. origin: what they were read from · cameras: of their training ·
    assumes: what their file does not say.

    Raises FieldFormatError: MESH_INVALID, NO_ZERO_LEVEL where no camera sees a surface, and what ``overrides`` is
    refused for.
    """
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("as", "cameras", "node"))
    splats, lost = sound(splats)
    scale = overrides.world_scale or 1.0
    within = None if overrides.as_ is None else overrides.as_ == "scene"
    bounds = None if overrides.bounds is None else np.array(overrides.bounds) / scale
    region = region_of(splats, bounds, within)
    shown = touching(splats)
    near = local_origin([region.low.tolist(), region.high.tolist()])
    shift = np.array(near or (0.0, 0.0, 0.0))
    splats = replace(splats, means=splats.means - shift).chosen(shown)
    region = replace(region, low=region.low - shift, high=region.high - shift)
    voxels = _VOXELS_WITHIN if region.within else _VOXELS
    voxel = region.longest / voxels
    if cameras is None:
        placed = cameras_for(splats, region)
    else:
        placed = given_cameras(cameras, _into_file(overrides, cameras, shift))
    alone = cameras is None and not region.within
    views, share = agreed(drawn(prepared(splats), placed, voxel, _workers()), voxel, alone, cameras is None)
    views = [_cropped(view, region, voxel) for view in views]
    own_bounds = None if bounds is None else (scale * (bounds - shift)).tolist()
    said = replace(overrides, family=None, as_=None, cameras=CamerasDescription(), bounds=own_bounds)
    fused = _fused(views, voxel, replace(said, truncation=_TRUNCATION * voxel), tensor_bytes)
    floating = len(shown) - len(splats)
    kind = "surfels (2D Gaussians)" if splats.flat else "Gaussians"
    why = (
        f"{origin}: {len(shown):,} {kind}, {splats.harmonics.shape[1]} coefficients of color each",
        _from_where(region, cameras, len(views)),
    )
    text = (
        f"the surface is where half of the light is stopped, in depths of {len(views)} views, fused to voxels of "
        f"1/{voxels} of the longest edge; left out were {floating:,} Gaussians apart from all others, and "
        f"{100 * share:.1f} % of the depths, which other views contradicted"
    )
    warnings = [f"SURFACE_RECONSTRUCTED: {text}"]
    if lost:
        warnings.append(f"PARTS_LEFT_OUT: {lost} Gaussians with NaN, infinity or no rotation")
    description = {**fused.description, "source": {"family": FAMILY}}
    if near is not None:
        entries = {name: description[name] for name in ("bounds", "world_scale")}
        entries["bounds"] = [(np.array(corner) + scale * shift).tolist() for corner in entries["bounds"]]
        description |= entries_at(entries, near)
    grid, words = _observation(views, region, voxel, alone)
    if alone:
        fused = _filled(fused, grid, words)
    found = replace(fused, family=FAMILY, why=why, description=description, warnings=tuple(warnings), assumes=assumes)
    return observed_field(found, grid, words, f"in depths of {len(views)} views")


def _workers() -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    return max(1, min(cores, int(os.environ.get("OMP_NUM_THREADS") or cores)))


def _into_file(overrides: UploadDescription, cameras: Trained, shift: Doubles) -> Doubles:
    """(4, 4), from the shifted Gaussians to the frame of the cameras: the dataset's where its transform is known."""
    known = np.eye(4) if overrides.dataset_transform is None else np.array(overrides.dataset_transform)
    back = np.array(shift_rows(shift.tolist()))
    T = known @ back if cameras.T_dataset_file is None else np.linalg.inv(cameras.T_dataset_file) @ known @ back
    return np.asarray(T)


def _from_where(region: Region, cameras: Trained | None, count: int) -> str:
    if cameras is not None:
        return f"seen from {count} of the {len(cameras)} cameras that came with it"
    if region.within:
        return f"seen in {count} views from places in its free space, as a scene; if it is an object, give as: object"
    return f"seen in {count} views from around it, as an object; if it is a scene, give as: scene"


def _cropped(view: Seen, region: Region, voxel: float) -> Seen:
    """Without depths that end outside of the region."""
    ends = view.ends()
    low, high = region.low - _BEYOND * voxel, region.high + _BEYOND * voxel
    inside = ((ends >= low) & (ends <= high)).all(axis=-1)
    return replace(view, depth=np.where(inside | np.isnan(view.depth), view.depth, np.float32(0.0)))


def _fused(views: list[Seen], voxel: float, said: UploadDescription, tensor_bytes: int) -> ConvertedField:
    """Raises FieldFormatError (NO_ZERO_LEVEL)."""
    poses: list[Doubles] = [np.linalg.inv(view.camera.T_camera_world).astype(np.float64) for view in views]
    depths = [np.nan_to_num(view.depth) for view in views]
    farthest = max((float(depth.max(initial=0.0)) for depth in depths), default=0.0)
    grid = BlockGrid(voxel, _TRUNCATION, 1.01 * farthest)
    arrays = fused_arrays(depths, [view.camera.matrix for view in views], poses, grid, [view.color for view in views])
    if arrays is None:
        message = "no view sees a surface: the Gaussians stop less than half of the light everywhere"
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
