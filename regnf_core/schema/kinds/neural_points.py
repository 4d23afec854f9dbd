"""The kind ``neural_points``: a map of points with features, decoded by a small network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

from regnf_core.schema.description import FieldDescription
from regnf_core.schema.kinds.voxel_grid import Length
from regnf_core.schema.layers import check_layers, count_layers, layer_tensor_names
from regnf_core.schema.tensor_check import TensorSpec, count_rows, require, require_names, require_shape


@dataclass(frozen=True, kw_only=True)
class NeuralPointsDescription(FieldDescription):
    """A field of the neural_points kind; see :class:`regnf_core.fields.neural_points.NeuralPointsFunction`."""

    kind: Literal["neural_points"]
    cell_size: Length
    """Edge of the cells that hold one point each."""
    buffer_size: Annotated[int, Ge(1), Le(1 << 40)]
    """Cells have numbers below this."""
    reach: Annotated[float, Ge(1), Le(8)]
    """Points are looked for in cells less than this many cells away."""
    max_distance: Length
    """Points farther away than this do not count."""
    neighbors: Annotated[int, Ge(1), Le(64)]
    """How many of the nearest points count."""
    blend_first: bool
    """True: features are blended, then decoded; false: the other way round."""
    oriented: bool = False
    """Whether the points' frames are turned: quaternions tell how."""

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        layers = count_layers(tensors)
        names = layer_tensor_names(layers)
        require_names(tensors, names | {"points", "features"} | ({"orientations"} if self.oriented else set()))
        points = count_rows(tensors, "points")
        require_shape(tensors, "points", (points, 3))
        shape = tensors["features"].shape
        require(len(shape) == 2, f"features has shape {shape}, expected one row a point")
        require_shape(tensors, "features", (points, shape[1]))
        if self.oriented:
            require_shape(tensors, "orientations", (points, 4))
        check_layers(tensors, shape[1] + 3)
