"""Open3D's VoxelBlockGrid as ``save`` writes it: truncated distances in blocks of voxels, with weights and colors."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from regnf_core.importing.arrays import Float32Array, StoredArray, tensor_error
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.containers.voxel_maps import (
    BoolArray,
    IntArray,
    fill_unseen,
    require_shape_of_blocks,
    seen_extent,
    tell_truncation,
)
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.shared import refuse_other_entries, require_family, shared_entries
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "open3d_voxel_block_grid"
_NEEDED = ("key", "block_resolution", "voxel_size", "attr_name_tsdf")
_INDEX = re.compile(r"[0-9]{1,3}")
_LARGEST_EDGE = 256
_DOUBTFUL = 0.15
"""A slope that is farther from 1 than this does not tell the truncation."""

_T = TypeVar("_T", bound=np.generic)


@dataclass(frozen=True)
class _Blocks:
    """tsdf: (B, R, R, R), cut off at 1, and which voxels were seen, both x first · keys: (B, 3)."""

    tsdf: Float32Array
    seen: BoolArray
    keys: IntArray
    voxel_size: float


def convert(arrays: ArraySource, overrides: UploadDescription) -> ConvertedField | None:
    """The map in ``arrays``, or None where they are not those of a VoxelBlockGrid with truncated distances.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, INVALID_DESCRIPTION, TENSOR_MISSING, TENSOR_SHAPE and what
    ArraySource raises.
    """
    if not all(name in arrays for name in _NEEDED):
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("truncation",))
    blocks = _read(arrays)
    truncation, why, warnings = _truncation(blocks, overrides)
    values: Float32Array = np.multiply(blocks.tsdf, np.float32(truncation))
    fill_unseen(values, blocks.seen, blocks.voxel_size, overrides.sign or 1)
    low, high = seen_extent(blocks.keys, blocks.seen)
    description = {
        "kind": "voxel_blocks",
        **shared_entries(overrides, [(blocks.voxel_size * corner).tolist() for corner in (low, high)]),
        "voxel_size": blocks.voxel_size,
        "source": {"family": FAMILY},
    }
    told = f"arrays key, block_resolution and attr_name_tsdf: {len(blocks.keys)} blocks of {values.shape[1]}^3 voxels"
    tensors: dict[str, StoredArray] = {"values": values, "blocks": blocks.keys.astype(np.int32)}
    return ConvertedField(FAMILY, (told, why), description, tensors, warnings)


def _read(arrays: ArraySource) -> _Blocks:
    """The blocks in which something was seen."""
    edge, voxel_size = _one(arrays, "block_resolution"), _one(arrays, "voxel_size")
    if not 1 <= edge <= _LARGEST_EDGE or edge != int(edge) or not 1e-9 <= voxel_size <= 1e9:
        raise tensor_error(f"blocks of {edge:g}^3 voxels of {voxel_size:g} make no map", "TENSOR_SHAPE")
    keys = arrays.integers("key")
    if keys.ndim != 2 or keys.shape[1] != 3 or not keys.size or keys.max() >= 1 << 31 or keys.min() < -(1 << 31):
        raise tensor_error(f"key has shape {keys.shape}, expected (any, 3) block indices", "TENSOR_SHAPE")
    tsdf = _voxels(arrays.array(_attribute(arrays, "tsdf")))
    seen = _voxels(arrays.positive(_attribute(arrays, "weight"))) if "attr_name_weight" in arrays else np.isfinite(tsdf)
    for name, voxels in (("tsdf", tsdf), ("weight", seen)):
        require_shape_of_blocks(name, voxels, len(keys), int(edge))
    kept = seen.any(axis=(1, 2, 3))
    if not kept.any():
        raise tensor_error("no voxel was ever seen: all weights are zero", "TENSOR_SHAPE")
    return _Blocks(tsdf[kept], seen[kept], keys[kept], voxel_size)


def _truncation(blocks: _Blocks, overrides: UploadDescription) -> tuple[float, str, tuple[str, ...]]:
    """The distance that the value 1 stands for, how it was told, and warnings."""
    if overrides.truncation is not None:
        return overrides.truncation, "the description gives the truncation", ()
    voxels, slope = tell_truncation(blocks.tsdf, blocks.seen)
    distance = voxels * blocks.voxel_size
    if slope is None:
        why = f"truncation of {voxels:g} voxels, as usual: there is too little surface to tell it from"
    else:
        why = f"truncation of {voxels:g} voxels: under it the values' slope at the surface is {slope:.2f}"
    certain = slope is not None and abs(slope - 1.0) <= _DOUBTFUL
    warning = f"TRUNCATION_ASSUMED: distances are cut off at {distance:g}; if not so, say 'truncation'"
    return distance, why, () if certain else (warning,)


def _attribute(arrays: ArraySource, name: str) -> str:
    """The array that holds the attribute ``name``."""
    number = _one(arrays, f"attr_name_{name}")
    text = f"{number:g}"
    if not _INDEX.fullmatch(text):
        raise tensor_error(f"attr_name_{name} is not the number of an array", "TENSOR_SHAPE")
    return f"value_{int(text):03d}"


def _one(arrays: ArraySource, name: str) -> float:
    numbers = arrays.numbers(name)
    if numbers.size != 1:
        raise tensor_error(f"{name} has shape {numbers.shape}, expected one number", "TENSOR_SHAPE")
    return float(numbers.reshape(()))


def _voxels(values: npt.NDArray[_T]) -> npt.NDArray[_T]:
    """(B, R, R, R) x first, contiguous, from (B, R, R, R, 1) with x last."""
    if values.ndim != 5 or values.shape[-1] != 1:
        raise tensor_error(f"the voxels have shape {values.shape}, expected blocks of one number each", "TENSOR_SHAPE")
    return np.ascontiguousarray(values[..., 0].transpose(0, 3, 2, 1))
