"""Fusion of one half of a sequence by Open3D's VoxelBlockGrid, as its users do it."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

import numpy as np
import open3d
from numpy.typing import NDArray

from benchmarks.real.sequence import FARTHEST_M, Recording
from regnf_core import SdfField
from regnf_core.loading import open_field

TRUNCATION_VOXELS = 8.0
"""Open3D's default."""
_BLOCK, _BLOCKS = 16, 50_000


def fuse(recording: Recording, frames: Iterable[int], voxel_m: float, path: Path) -> None:
    """Write the fused map to ``path`` (.npz) and its surface beside it (.ply)."""
    core = open3d.core
    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"),
        (core.float32, core.float32),
        (core.SizeVector(1), core.SizeVector(1)),
        voxel_m,
        _BLOCK,
        _BLOCKS,
    )
    camera = core.Tensor.from_numpy(recording.intrinsics)
    for frame in frames:
        image = open3d.t.geometry.Image(recording.depth(frame))
        to_camera = core.Tensor.from_numpy(np.linalg.inv(recording.pose(frame)))
        blocks = grid.compute_unique_block_coordinates(image, camera, to_camera, 1.0, FARTHEST_M, TRUNCATION_VOXELS)
        grid.integrate(blocks, image, camera, to_camera, 1.0, FARTHEST_M, TRUNCATION_VOXELS)
    grid.save(str(path))
    open3d.io.write_triangle_mesh(path.with_suffix(".ply"), grid.extract_triangle_mesh().to_legacy())


def open_fused(path: Path) -> SdfField:
    """The map's field, world frame. Its truncation is said: where there is noise, the values do not always tell it."""
    return open_field(path, {"truncation": TRUNCATION_VOXELS * voxel_of(path)})


def voxel_of(path: Path) -> float:
    """From node to node of a fused map, meters."""
    with np.load(path) as arrays:
        return float(arrays["voxel_size"].item())


@cache
def surface(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vertices (N, 3) of the surface beside a fused map, and their normals (N, 3) towards free space, world frame."""
    mesh = open3d.io.read_triangle_mesh(path.with_suffix(".ply"))
    mesh.compute_vertex_normals()
    return np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
