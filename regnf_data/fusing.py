"""Posed depth images fused to a regnf field file, imported as what users upload is."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError
from regnf_core.importing.fusing import BlockGrid, Progress, fused_arrays
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits


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
    arrays = fused_arrays(
        list(depths), list(intrinsics), list(T_world_camera), grid, None if colors is None else list(colors), progress
    )
    if arrays is None:
        raise DatasetError("no depth image shows a surface within the depth limit", reason="DATASET_NOTHING_IN_BOUNDS")
    source = path.with_suffix(".npz")
    try:
        np.savez(source, **arrays)  # type: ignore[arg-type]
        import_own(source, path, {"truncation": grid.truncation * grid.voxel})
    finally:
        source.unlink(missing_ok=True)


def import_own(source: Path, path: Path, description: dict[str, Any]) -> None:
    """What ``regnf convert`` does, in this process: the file ``source`` is our own."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        convert_file(source, Path(folder), {**description, "accept_implausible": True}, ImportLimits())
        (Path(folder) / FIELD_NAME).replace(path)
