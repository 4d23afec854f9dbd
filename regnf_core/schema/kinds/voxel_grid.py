"""The kind ``voxel_grid``: distances at the nodes of a regular grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

from regnf_core.schema.description import FieldDescription
from regnf_core.schema.tensor_check import TensorSpec, require, require_names, require_shape

Coordinate = Annotated[float, Ge(-1e9), Le(1e9)]
Place = tuple[Coordinate, Coordinate, Coordinate]
Length = Annotated[float, Ge(1e-9), Le(1e9)]
WEIGHTS = "weights"
"""The tensor that says how much was seen of each node: 0 where nothing was. It may be missing."""


@dataclass(frozen=True, kw_only=True)
class VoxelGridDescription(FieldDescription):
    """A field of the voxel_grid kind; see :class:`regnf_core.fields.voxel_grid.VoxelGridFunction`."""

    kind: Literal["voxel_grid"]
    origin: Place
    """Where node (0, 0, 0) is, in the function's coordinates."""
    spacing: tuple[Length, Length, Length]
    """From node to node along x, y and z."""

    def node_shape(self, tensors: Mapping[str, TensorSpec]) -> tuple[int, ...]:
        """(X, Y, Z)"""
        return tensors["values"].shape

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        require_names(tensors, {"values"} | (tensors.keys() & {WEIGHTS}))
        shape = tensors["values"].shape
        require(len(shape) == 3 and min(shape) >= 2, f"values has shape {shape}, expected two nodes an axis at least")
        if WEIGHTS in tensors:
            require_shape(tensors, WEIGHTS, shape)
