"""Truncated signed distances fused from depth images by Open3D, written as its users write them."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from regnf_data.fusing import BlockGrid, DepthImages, fuse_blocks, import_own, open3d
from regnf_data.worlds.capture import Capture
from regnf_data.worlds.mesh import Array

Volume = Literal["blocks", "dense"]
LARGEST_DENSE = 200
"""Voxels along an edge of a dense grid."""
_DENSE_IMAGES = 40


@dataclass(frozen=True)
class Fusion:
    """voxel_m: from node to node · truncation: voxels · volume: Open3D's VoxelBlockGrid, or one dense grid."""

    voxel_m: float
    truncation: float
    volume: Volume
    farthest_m: float


def fuse(taken: Capture, fusion: Fusion, bounds: Array, path: Path) -> None:
    """Write the safe field of the fused images to ``path``, imported from the file that a user would upload.

    bounds: (2, 3), what a dense grid covers. Raises DatasetError where nothing was measured.
    """
    if fusion.volume == "blocks":
        intrinsics = np.tile(taken.sensor.intrinsics, (len(taken.poses), 1, 1))
        grid = BlockGrid(fusion.voxel_m, fusion.truncation, fusion.farthest_m)
        fuse_blocks(DepthImages(taken.depths, intrinsics, taken.estimated), grid, path)
        return
    source = path.with_suffix(".npz")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _save_dense(taken, fusion, bounds, source)
    import_own(source, path, {})
    source.unlink()


def write_dense(path: Path, values: NDArray[np.float32], origin: Array, spacing: float) -> None:
    """Write the safe field of distances at the nodes (X, Y, Z) of a grid to ``path``."""
    source = path.with_suffix(".npz")
    np.savez(source, sdf=values, origin=origin, spacing=np.float64(spacing))
    import_own(source, path, {})
    source.unlink()


def _save_dense(taken: Capture, fusion: Fusion, bounds: Array, path: Path) -> None:
    o3d = open3d()
    length = float((bounds[1] - bounds[0]).max())
    count = min(int(np.ceil(length / fusion.voxel_m)), LARGEST_DENSE)
    every = max(1, len(taken.poses) // _DENSE_IMAGES)
    volume = o3d.pipelines.integration.UniformTSDFVolume(
        length=length,
        resolution=count,
        sdf_trunc=fusion.truncation * length / count,
        color_type=o3d.pipelines.integration.TSDFVolumeColorType.NoColor,
        origin=bounds[0],
    )
    height, width = taken.sensor.size
    K = taken.sensor.intrinsics
    # Of this volume's images, whole numbers are the middles of pixels.
    camera = o3d.camera.PinholeCameraIntrinsic(width, height, K[0, 0], K[1, 1], K[0, 2] - 0.5, K[1, 2] - 0.5)
    color = o3d.geometry.Image(np.zeros((height, width, 3), np.uint8))
    for depth, pose in zip(taken.depths[::every], taken.estimated[::every], strict=True):
        image = o3d.geometry.Image(np.ascontiguousarray(depth))
        both = o3d.geometry.RGBDImage.create_from_color_and_depth(color, image, 1.0, fusion.farthest_m, True)
        volume.integrate(both, camera, np.linalg.inv(pose))
    values = np.asarray(volume.extract_volume_tsdf())  # (count^3, 2)
    tsdf, weight = values.reshape(count, count, count, 2).transpose(3, 0, 1, 2)
    voxel = length / count
    np.savez(
        path,
        sdf=(tsdf * fusion.truncation * voxel).astype(np.float32),
        weight=weight.astype(np.float32),
        origin=np.asarray(bounds[0]) + voxel / 2.0,
        spacing=np.float64(voxel),
    )
