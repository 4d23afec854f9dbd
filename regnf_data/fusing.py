"""Truncated signed distances fused from posed depth images by Open3D's VoxelBlockGrid, written as its users write them
and imported as what they upload is."""

from __future__ import annotations

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


@dataclass(frozen=True, eq=False)
class DepthImages:
    """depths: (N, H, W) float32 along the camera's axis, world units, 0 where nothing was read · intrinsics: (N, 3, 3),
    a pixel's center at (column + .5, row + .5) · T_world_camera: (N, 4, 4), OpenCV's axes · colors: (N, H, W, 3) uint8.
    """

    depths: NDArray[np.float32]
    intrinsics: NDArray[np.float64]
    T_world_camera: NDArray[np.float64]
    colors: NDArray[np.uint8] | None = None


def fuse_blocks(images: DepthImages, grid: BlockGrid, path: Path, progress: Progress | None = None) -> None:
    """Write the safe field of the fused images to ``path``.

    Raises DatasetError (DATASET_NOTHING_IN_BOUNDS) where no image shows surface within reach.
    """
    source = path.with_suffix(".npz")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _save(images, grid, source, progress)
        import_own(source, path, {"truncation": grid.truncation * grid.voxel})
    finally:
        source.unlink(missing_ok=True)


def import_own(source: Path, path: Path, description: dict[str, Any]) -> None:
    """What ``regnf convert`` does, in this process: the file ``source`` is our own."""
    out = path.parent / f"{path.stem}-import"
    out.mkdir(exist_ok=True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            convert_file(source, out, {**description, "accept_implausible": True}, ImportLimits())
        (out / FIELD_NAME).replace(path)
    finally:
        for left in out.iterdir():
            left.unlink()
        out.rmdir()


def open3d() -> Any:
    """The library, whose type stubs leave out what numpy arrays may be given to."""
    import open3d as library

    return library


def _save(images: DepthImages, grid: BlockGrid, path: Path, progress: Progress | None) -> None:
    o3d = open3d()
    core = o3d.core
    names: tuple[str, ...] = ("tsdf", "weight")
    channels: tuple[int, ...] = (1, 1)
    if images.colors is not None:
        names, channels = (*names, "color"), (*channels, 3)
    types = tuple(core.float32 for _ in names)
    blocks = o3d.t.geometry.VoxelBlockGrid(names, types, channels, grid.voxel, _EDGE, _BLOCKS, core.Device("CPU:0"))
    fused = 0
    for number, depth in enumerate(images.depths):
        if progress is not None:
            progress(number)
        if not (depth > 0.0).any():
            continue
        K = core.Tensor(np.ascontiguousarray(images.intrinsics[number]))
        camera = core.Tensor(np.linalg.inv(images.T_world_camera[number]))
        reach = (1.0, float(grid.farthest), float(grid.truncation))
        image = o3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(depth[..., None])))
        near = _blocks_near(blocks, image, K, camera, reach)
        if near is None:
            continue
        fused += 1
        if images.colors is None:
            blocks.integrate(near, image, K, camera, *reach)
            continue
        color = (images.colors[number] / np.float32(255.0)).astype(np.float32)
        blocks.integrate(near, image, o3d.t.geometry.Image(core.Tensor(color)), K, K, camera, *reach)
    if fused == 0:
        raise DatasetError("no depth image shows surface within reach", reason="DATASET_NOTHING_IN_BOUNDS")
    blocks.save(str(path))
    _sort(path)


def _blocks_near(blocks: Any, image: Any, K: Any, camera: Any, reach: tuple[float, float, float]) -> Any:
    """Coordinates of the blocks near an image's surface; None where it shows none within reach."""
    try:
        return blocks.compute_unique_block_coordinates(image, K, camera, *reach)
    except RuntimeError as error:
        if _NOTHING_NEAR in str(error):
            return None
        raise


def _sort(path: Path) -> None:
    """Order the blocks by their place: Open3D's threads leave them in any order, and maps shall be repeatable."""
    with np.load(path) as stored:
        arrays = dict(stored)
    order = np.lexsort(arrays["key"].T)
    for name, array in arrays.items():
        if array.ndim > 1 and len(array) == len(order):
            arrays[name] = array[order]
    np.savez(path, **arrays)
