"""Open3D's VoxelBlockGrid as ``save`` writes it: truncated distances in blocks of voxels, with weights and colors."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, StoredArray, tensor_error
from regnf_core.importing.containers.euclidean import (
    PROJECTIVE,
    IntArray,
    bound_by_surface,
    doubts_of_map,
    fill_unseen,
    length_of_one,
    measure_from_surface,
    near_blocks,
    require_shape_of_blocks,
    seen_extent,
    stored_weights,
)
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.families.color.head import with_values
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import entries_at, refuse_other_entries, require_family, shared_entries
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "open3d_voxel_block_grid"
_NEEDED = ("key", "block_resolution", "voxel_size", "attr_name_tsdf")
_INDEX = re.compile(r"[0-9]{1,3}")
_LARGEST_EDGE = 256
_LARGEST = 1.001
"""Values beyond this were not divided by the truncation."""
_USUAL = 8.0
"""Open3D's default of ``trunc_voxel_multiplier``."""

_T = TypeVar("_T", bound=np.generic)


@dataclass(frozen=True)
class _Blocks:
    """tsdf: (B, R, R, R), cut off at 1, and how much was seen of the voxels, both x first · keys: (B, 3), near 0."""

    tsdf: Float32Array
    weights: Float32Array
    keys: IntArray
    voxel_size: float
    kept: npt.NDArray[np.bool_]
    """Which of the file's blocks they are."""
    origin: list[float] | None
    """What was subtracted from the file's places; None: nothing."""


def convert(arrays: ArraySource, overrides: UploadDescription) -> ConvertedField | None:
    """The map in ``arrays``, or None where they are not those of a VoxelBlockGrid with truncated distances.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, INVALID_DESCRIPTION, TENSOR_MISSING, TENSOR_SHAPE,
    TRUNCATION_UNKNOWN and what ArraySource raises.
    """
    if not all(name in arrays for name in _NEEDED):
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("truncation",))
    blocks = _read(arrays)
    seen = blocks.weights > 0
    values, reasons, warnings = _distances(blocks, seen, overrides)
    fill_unseen(values, seen, blocks.voxel_size, overrides.sign or 1)
    low, high = (blocks.voxel_size * corner + (blocks.origin or [0.0] * 3) for corner in seen_extent(blocks.keys, seen))
    description = {
        "kind": "voxel_blocks",
        **entries_at(shared_entries(overrides, [low.tolist(), high.tolist()]), blocks.origin),
        "voxel_size": blocks.voxel_size,
        "source": {"family": FAMILY},
    }
    told = f"arrays key, block_resolution and attr_name_tsdf: {len(blocks.keys)} blocks of {values.shape[1]}^3 voxels"
    tensors: dict[str, StoredArray] = {"values": values, "blocks": blocks.keys.astype(np.int32)}
    tensors["weights"] = stored_weights(blocks.weights)
    converted = ConvertedField(FAMILY, (told, *reasons), description, tensors, warnings)
    if "attr_name_color" not in arrays or overrides.color.keep is False:
        return converted
    return with_values(converted, lambda: _colors(arrays, blocks))


def _colors(arrays: ArraySource, blocks: _Blocks) -> npt.NDArray[np.float16] | None:
    """(B, R, R, R, 3) in [0, 1], x first, -1 where nothing was seen; None where all are black: no colors were given."""
    stored = arrays.weights(_attribute(arrays, "color"))  # 0 to 255
    edge = blocks.tsdf.shape[1]
    if stored.shape != (len(blocks.kept), edge, edge, edge, 3):
        raise tensor_error(f"the colors have shape {stored.shape}, expected three numbers per voxel", "TENSOR_SHAPE")
    if not stored.any():
        return None
    colors = (stored[blocks.kept].transpose(0, 3, 2, 1, 4) / np.float32(255.0)).clip(0.0, 1.0)
    colors[blocks.weights <= 0.0] = -1.0
    return np.ascontiguousarray(colors, dtype=np.float16)


def _read(arrays: ArraySource) -> _Blocks:
    """The blocks in which something was seen."""
    edge, voxel_size = _one(arrays, "block_resolution"), _one(arrays, "voxel_size")
    if not 1 <= edge <= _LARGEST_EDGE or edge != int(edge) or not 1e-9 <= voxel_size <= 1e9:
        raise tensor_error(f"blocks of {edge:g}^3 voxels of {voxel_size:g} make no map", "TENSOR_SHAPE")
    keys = arrays.integers("key")
    if keys.ndim != 2 or keys.shape[1] != 3 or not keys.size or keys.max() >= 1 << 31 or keys.min() < -(1 << 31):
        raise tensor_error(f"key has shape {keys.shape}, expected (any, 3) block indices", "TENSOR_SHAPE")
    tsdf = _voxels(arrays.array(_attribute(arrays, "tsdf")))
    weighted = "attr_name_weight" in arrays
    weights = _voxels(arrays.weights(_attribute(arrays, "weight"))) if weighted else np.ones_like(tsdf)
    for name, voxels in (("tsdf", tsdf), ("weight", weights)):
        require_shape_of_blocks(name, voxels, len(keys), int(edge))
    kept = (weights > 0).any(axis=(1, 2, 3))
    if not kept.any():
        raise tensor_error("no voxel was observed: all weights are zero", "TENSOR_SHAPE")
    near, origin = near_blocks(keys[kept], edge * voxel_size)
    return _Blocks(tsdf[kept], weights[kept], near, voxel_size, np.asarray(kept), origin)


def _distances(
    blocks: _Blocks, seen: npt.NDArray[np.bool_], overrides: UploadDescription
) -> tuple[Float32Array, tuple[str, ...], tuple[str, ...]]:
    """The voxels' distances, how they were told, and warnings.

    The file does not say which distance the value 1 stands for. Where the values are projective, they cannot tell it
    either: twice the truncation and a camera that looked at 60 degrees leave the same ones. So the distances are then
    measured from the surface, and the usual truncation says only where they are cut off.
    Raises FieldFormatError (TRUNCATION_UNKNOWN).
    """
    size, truncation = blocks.voxel_size, overrides.truncation
    why = f"truncation {truncation:g}, from the config file or the import options" if truncation is not None else ""
    if truncation is None:
        largest = float(np.abs(blocks.tsdf[seen]).max())
        if largest > _LARGEST:
            said = f"values up to {largest:.3g}, while values divided by the truncation are at most 1"
            raise FieldFormatError(f"the truncation of the map is not in the file: {said}", reason="TRUNCATION_UNKNOWN")
        if (voxels := length_of_one(blocks.tsdf, seen, blocks.keys)) is not None:
            truncation = voxels * size
            why = f"truncation of {voxels:g} voxels: by the distances to the surface"
    if truncation is not None:
        values: Float32Array = np.multiply(blocks.tsdf, np.float32(truncation))
        doubts = doubts_of_map(values, seen, blocks.keys, size)
        projective = bound_by_surface(values, seen, blocks.keys, size)
        return values, ((why, PROJECTIVE) if projective else (why,)), doubts
    doubts = doubts_of_map(blocks.tsdf, seen, blocks.keys, None)
    measure_from_surface(blocks.tsdf, seen, blocks.keys, size, _USUAL * size)
    why = f"truncation of {_USUAL:g} voxels, Open3D's default: the values do not determine it"
    text = f"the truncation is not in the file: distances are measured from the surface, up to {_USUAL * size:.4g} "
    text += (
        f"({_USUAL:g} voxels, Open3D's default); if it was fused with another one, give the import option truncation"
    )
    return blocks.tsdf, (why,), (*doubts, f"TRUNCATION_ASSUMED: {text}")


def _attribute(arrays: ArraySource, name: str) -> str:
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
