"""Truncated signed distances fused from posed depth images by Open3D's VoxelBlockGrid, written as its users write them
and imported as what they upload is."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits

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


def fuse_blocks(
    depths: NDArray[np.float32],
    intrinsics: NDArray[np.float64],
    T_world_camera: NDArray[np.float64],
    grid: BlockGrid,
    path: Path,
    colors: NDArray[np.uint8] | None = None,
    progress: Progress | None = None,
) -> None:
    """Write the regnf field file of the fused images to ``path``.

    depths: (N, H, W) along the camera's axis, world units, 0 where nothing was read · intrinsics: (N, 3, 3), a pixel's
    center at (column + 0.5, row + 0.5) · T_world_camera: (N, 4, 4), OpenCV's axes · colors: (N, H, W, 3).
    Raises DatasetError (DATASET_NOTHING_IN_BOUNDS) where no image shows surface within reach.
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
    if fused == 0:
        raise DatasetError("no depth image shows a surface within the depth limit", reason="DATASET_NOTHING_IN_BOUNDS")
    source = path.with_suffix(".npz")
    try:
        blocks.save(str(source))
        with np.load(source) as stored:
            arrays = dict(stored)
        order = np.lexsort(arrays["key"].T)  # Open3D's threads leave them in any order, and maps shall be repeatable
        moved = {name: a[order] for name, a in arrays.items() if a.ndim > 1 and len(a) == len(order)}
        np.savez(source, **(arrays | moved))
        import_own(source, path, {"truncation": grid.truncation * grid.voxel})
    finally:
        source.unlink(missing_ok=True)


def import_own(source: Path, path: Path, description: dict[str, Any]) -> None:
    """What ``regnf convert`` does, in this process: the file ``source`` is our own."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        convert_file(source, Path(folder), {**description, "accept_implausible": True}, ImportLimits())
        (Path(folder) / FIELD_NAME).replace(path)


def open3d() -> Any:
    """The library, whose type stubs leave out what numpy arrays may be given to."""
    import open3d as library

    return library
