"""The kind ``grid_mlp``: a hash grid's features alone into a small ReLU network, within a cube."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Gt, Le

from regnf_core.schema.description import FieldDescription
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.layers import check_layers, count_layers, layer_tensor_names
from regnf_core.schema.tensor_check import TensorSpec, require_names, require_shape


@dataclass(frozen=True, kw_only=True)
class GridMlpDescription(FieldDescription):
    """A field of the grid_mlp kind; see :class:`regnf_core.fields.grid_mlp.GridMlpFunction`."""

    kind: Literal["grid_mlp"]
    hash: HashGridConfig
    grid_radius: Annotated[float, Gt(0), Le(1e6)] = 1.0
    """The grid covers [-grid_radius, grid_radius]^3."""

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        layers = count_layers(tensors)
        names = layer_tensor_names(layers)
        require_names(tensors, names | {"hash_table"})
        require_shape(tensors, "hash_table", (self.hash.entries, self.hash.features_per_level))
        check_layers(tensors, self.hash.width)
