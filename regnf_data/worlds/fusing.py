"""Truncated signed distances fused from depth images by Open3D, written as its users write them."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from regnf_data.worlds.capture import Capture
from regnf_data.worlds.mesh import Array

Volume = Literal["blocks", "dense"]
_EDGE = 8
_BLOCKS = 20_000
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

    bounds: (2, 3), what a dense grid covers. Raises FieldFormatError where nothing was measured.
    """
    source = path.with_suffix(".npz")
    description: dict[str, Any] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if fusion.volume == "blocks":
            _save_blocks(taken, fusion, source)
            description["truncation"] = fusion.truncation * fusion.voxel_m
        else:
            _save_dense(taken, fusion, bounds, source)
    _import(source, path, description)


def write_dense(path: Path, values: NDArray[np.float32], origin: Array, spacing: float) -> None:
    """Write the safe field of distances at the nodes (X, Y, Z) of a grid to ``path``."""
    source = path.with_suffix(".npz")
    np.savez(source, sdf=values, origin=origin, spacing=np.float64(spacing))
    _import(source, path, {})


def _import(source: Path, path: Path, description: dict[str, Any]) -> None:
    """What ``regnf convert`` does, in this process: the file is our own."""
    out = path.parent / f"{path.stem}-import"
    out.mkdir(exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        convert_file(source, out, {**description, "accept_implausible": True}, ImportLimits())
    (out / FIELD_NAME).replace(path)
    out.rmdir()
    source.unlink()


def _open3d() -> Any:
    """The library, whose type stubs leave out what numpy arrays may be given to."""
    import open3d

    return open3d


def _save_blocks(taken: Capture, fusion: Fusion, path: Path) -> None:
    o3d = _open3d()
    core = o3d.core
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), fusion.voxel_m, _EDGE, _BLOCKS,
        core.Device("CPU:0"),
    )  # fmt: skip
    K = core.Tensor(taken.sensor.intrinsics)
    for depth, pose in zip(taken.depths, taken.estimated, strict=True):
        if not (depth > 0.0).any():
            continue
        image, extrinsic = o3d.t.geometry.Image(core.Tensor(depth[..., None])), core.Tensor(np.linalg.inv(pose))
        seen = (image, K, extrinsic, 1.0, float(fusion.farthest_m), float(fusion.truncation))
        blocks = grid.compute_unique_block_coordinates(*seen)
        grid.integrate(blocks, *seen)
    grid.save(str(path))


def _save_dense(taken: Capture, fusion: Fusion, bounds: Array, path: Path) -> None:
    o3d = _open3d()
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
