"""Truncated signed distances fused from posed depth images by Open3D's VoxelBlockGrid, as the arrays that it saves."""

from __future__ import annotations

import mimetypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_EDGE = 8
"""Voxels along an edge of a block."""
_BLOCKS = 20_000
"""To start with; Open3D makes room for more."""

_NOTHING_NEAR = "No block is touched"
"""What Open3D says of an image that has no depth within reach, at those pixels that it looks at."""

Progress = Callable[[int], None]
"""Called with the number of images that are fused."""


@dataclass(frozen=True)
class BlockGrid:
    """voxel: from node to node, world units · truncation: voxels · farthest: depths beyond are left out."""

    voxel: float
    truncation: float
    farthest: float


def fused_arrays(
    depths: Sequence[NDArray[np.float32]],
    intrinsics: Sequence[NDArray[np.float64]],
    T_world_camera: Sequence[NDArray[np.float64]],
    grid: BlockGrid,
    colors: Sequence[NDArray[np.uint8]] | None = None,
    progress: Progress | None = None,
) -> dict[str, NDArray[Any]] | None:
    """The arrays of a saved VoxelBlockGrid by their names, blocks in the order of their keys.

    depths: (H, W) each, along the camera's axis, world units, 0 where nothing was read · intrinsics: (3, 3) each, a
    pixel's center at (column + 0.5, row + 0.5) · T_world_camera: (4, 4) each, OpenCV's axes · colors: (H, W, 3) each.
    None where no image shows a surface within reach.
    """
    o3d = open3d()
    core, image_of = o3d.core, o3d.t.geometry.Image
    channels = {"tsdf": 1, "weight": 1} | ({} if colors is None else {"color": 3})
    types = (core.float32,) * len(channels)
    sizes = tuple(channels.values())
    blocks = o3d.t.geometry.VoxelBlockGrid(
        tuple(channels), types, sizes, grid.voxel, _EDGE, _BLOCKS, core.Device("CPU:0")
    )
    reach, fused = (1.0, float(grid.farthest), float(grid.truncation)), 0
    for number, depth in enumerate(depths):
        if progress is not None:
            progress(number)
        if not (depth > 0.0).any():
            continue
        K = core.Tensor(np.ascontiguousarray(intrinsics[number]))
        camera = core.Tensor(np.linalg.inv(T_world_camera[number]))
        image = image_of(core.Tensor(np.ascontiguousarray(depth[..., None])))
        try:
            near = blocks.compute_unique_block_coordinates(image, K, camera, *reach)
        except RuntimeError as error:
            if _NOTHING_NEAR in str(error):
                continue
            raise
        fused += 1
        if colors is None:
            blocks.integrate(near, image, K, camera, *reach)
        else:
            color = image_of(core.Tensor((colors[number] / np.float32(255.0)).astype(np.float32)))
            blocks.integrate(near, image, color, K, K, camera, *reach)
    return _stored(blocks, channels, grid) if fused else None


def _stored(blocks: Any, channels: dict[str, int], grid: BlockGrid) -> dict[str, NDArray[Any]]:
    """What VoxelBlockGrid.save writes. Open3D's threads leave blocks in any order; maps shall be repeatable."""
    table = blocks.hashmap()
    active = table.active_buf_indices().to(open3d().core.int64)
    keys = table.key_tensor()[active].numpy()
    order = np.lexsort(keys.T)
    arrays: dict[str, NDArray[Any]] = {
        "key": keys[order],
        "block_resolution": np.array([_EDGE], np.int64),
        "voxel_size": np.array([grid.voxel], np.float32),
    }
    for number, name in enumerate(channels):
        arrays[f"attr_name_{name}"] = np.array([number], np.int64)
        arrays[f"value_{number:03d}"] = blocks.attribute(name)[active].numpy()[order]
    return arrays


def open3d() -> Any:
    """The library, whose type stubs leave out what numpy arrays may be given to."""
    mimetypes.knownfiles.clear()  # what it brings along would read them, which the importer's process may not
    import open3d as library

    return library
