"""nvblox's maps: the blocks of its TSDF layer in a SQLite file."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, StoredArray, finite_float32, tensor_error
from regnf_core.importing.assumptions import AXES, METERS, SIGN
from regnf_core.importing.containers.euclidean import (
    PROJECTIVE,
    BoolArray,
    IntArray,
    bound_by_surface,
    doubts_of_map,
    fill_unseen,
    near_blocks,
    seen_extent,
    stored_weights,
)
from regnf_core.importing.containers.sqlite_source import TableSource
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import entries_at, refuse_other_entries, require_family, shared_entries
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "nvblox"
_DATA, _SETTINGS = "_data", "_metadata"
_EDGE = 8
_VOXELS = np.dtype([("distance", "<f4"), ("weight", "<f4")])
_BLOCK_BYTES = _EDGE**3 * _VOXELS.itemsize
_MAX_BLOCKS, _MAX_SETTINGS = 1 << 20, 1000
_FARTHEST = 1 << 31


def convert_database(tables: TableSource, tensor_bytes: int, overrides: UploadDescription) -> ConvertedField:
    """The map's truncated distances as a field.

    Raises FieldFormatError: FIELD_NOT_RECOGNIZED, FAMILY_NOT_SUPPORTED, INVALID_DESCRIPTION, TENSOR_MISSING,
    TENSOR_SHAPE, TENSOR_TOO_LARGE, TENSOR_NOT_FINITE and what TableSource raises.
    """
    layer = _layer(tables)
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY)
    voxel_size = _block_size(tables, layer) / _EDGE
    blocks, values, weights = _read(tables, layer, tensor_bytes)
    blocks, origin = near_blocks(blocks, _EDGE * voxel_size)
    seen: BoolArray = weights > 0
    doubts = doubts_of_map(values, seen, blocks, voxel_size)
    projective = bound_by_surface(values, seen, blocks, voxel_size)
    fill_unseen(values, seen, voxel_size, overrides.sign or 1)
    middle = voxel_size / 2.0
    low, high = (middle + voxel_size * corner + (origin or [0.0] * 3) for corner in seen_extent(blocks, seen))
    description = {
        "kind": "voxel_blocks",
        **entries_at(shared_entries(overrides, [low.tolist(), high.tolist()]), origin),
        "origin": [middle] * 3,
        "voxel_size": voxel_size,
        "source": {"family": FAMILY},
    }
    why: tuple[str, ...] = (
        f"tables {layer}{_DATA} and {layer}{_SETTINGS}: {len(blocks)} blocks of {_EDGE}^3 voxels",
        "values are at the centers of the voxels, in meters",
    )
    if projective:
        why = (*why, PROJECTIVE)
    tensors: dict[str, StoredArray] = {"values": values, "blocks": blocks.astype(np.int32)}
    tensors["weights"] = stored_weights(weights)
    return ConvertedField(FAMILY, why, description, tensors, doubts, assumes=(METERS, AXES, SIGN))


def _layer(tables: TableSource) -> str:
    """The name of the layer of truncated distances."""
    layers = [name.removesuffix(_DATA) for name in tables.tables if name.endswith(_DATA)]
    layers = sorted(layer for layer in layers if layer + _SETTINGS in tables.tables)
    if not layers:
        raise FieldFormatError("a database without voxel layers", reason="FIELD_NOT_RECOGNIZED")
    found = [layer for layer in layers if "tsdf" in layer.lower()]
    if len(found) != 1:
        message = f"a map with {len(found)} layers of truncated distances; its layers are {layers[:8]}"
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
    return found[0]


def _block_size(tables: TableSource, layer: str) -> float:
    """Edge of a block, meters."""
    columns = ("param_name", "value_float")
    settings = dict(tables.rows(layer + _SETTINGS, columns, _MAX_SETTINGS))
    size = settings.get("block_size")
    if not isinstance(size, float) or not 1e-6 <= size <= 1e6:
        raise tensor_error(f"{layer}{_SETTINGS} has no block_size", "TENSOR_MISSING")
    return size


def _read(tables: TableSource, layer: str, tensor_bytes: int) -> tuple[IntArray, Float32Array, Float32Array]:
    """The blocks (B, 3) in which something was seen, their distances (B, 8, 8, 8), x first, and their weights."""
    most = min(_MAX_BLOCKS, tensor_bytes // (_EDGE**3 * 4))
    indices: list[tuple[int, ...]] = []
    parts: list[npt.NDArray[Any]] = []
    for *index, data in tables.rows(layer + _DATA, ("index_x", "index_y", "index_z", "data"), most):
        if not all(isinstance(i, int) and abs(i) < _FARTHEST for i in index):
            raise tensor_error("a block's index is not a whole number", "TENSOR_SHAPE")
        if not isinstance(data, bytes) or len(data) != _BLOCK_BYTES:
            raise tensor_error(f"a block is not {_EDGE}^3 voxels of a distance and a weight", "TENSOR_SHAPE")
        voxels = np.frombuffer(data, dtype=_VOXELS)
        if (voxels["weight"] > 0).any():
            indices.append(tuple(index))
            parts.append(voxels)
    if not parts:
        raise tensor_error("no voxel was observed: there are no blocks, or all weights are zero", "TENSOR_SHAPE")
    voxels = np.stack(parts).reshape(-1, _EDGE, _EDGE, _EDGE)
    seen: BoolArray = np.asarray(voxels["weight"] > 0)
    values = finite_float32("the map", np.where(seen, voxels["distance"], np.float32(0.0)))
    weights = np.where(seen, np.minimum(voxels["weight"], np.float32(3e38)), np.float32(0.0))
    return np.array(indices, dtype=np.int64), values, weights
