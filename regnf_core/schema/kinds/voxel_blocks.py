"""The kind ``voxel_blocks``: distances in blocks of voxels, as maps made from depth images have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from regnf_core.schema.description import FieldDescription
from regnf_core.schema.kinds.voxel_grid import WEIGHTS, Length, Place
from regnf_core.schema.tensor_check import TensorSpec, count_rows, require, require_names, require_shape


@dataclass(frozen=True, kw_only=True)
class VoxelBlocksDescription(FieldDescription):
    """A field of the voxel_blocks kind; see :class:`regnf_core.fields.voxel_blocks.VoxelBlocksFunction`."""

    kind: Literal["voxel_blocks"]
    origin: Place = (0.0, 0.0, 0.0)
    """Where the first node of block (0, 0, 0) is, in the function's coordinates."""
    voxel_size: Length
    """From node to node."""

    def node_shape(self, tensors: Mapping[str, TensorSpec]) -> tuple[int, ...]:
        """(B, R, R, R)"""
        return tensors["values"].shape

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        require_names(tensors, {"values", "blocks"} | (tensors.keys() & {WEIGHTS}), integers={"blocks"})
        blocks = count_rows(tensors, "blocks")
        require_shape(tensors, "blocks", (blocks, 3))
        shape = tensors["values"].shape
        require(len(shape) == 4 and shape[1] >= 1, f"values has shape {shape}, expected blocks of voxels")
        require_shape(tensors, "values", (blocks, shape[1], shape[1], shape[1]))
        if WEIGHTS in tensors:
            require_shape(tensors, WEIGHTS, shape)
