"""The kind ``neus_facto``: hash grid, sines and cosines and the position itself into a small softplus network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le

from regnf_core.schema.description import FieldDescription
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.layers import check_layers, count_layers, layer_tensor_names, require_layer_count
from regnf_core.schema.positional_encoding import PositionalEncodingDescription
from regnf_core.schema.tensor_check import TensorSpec, require_names, require_shape

Contraction = Literal["none", "linf", "linf_grid"]

SKIP_LAYER = 4
"""A network with more layers than this sees its input again at this one."""


@dataclass(frozen=True, kw_only=True)
class NeusFactoDescription(FieldDescription):
    """A field of the neus-facto kind; see :class:`regnf_core.fields.neus_facto.NeusFactoFunction`."""

    kind: Literal["neus_facto"]
    hash: HashGridConfig | None = None
    """None: the network has no columns for a grid."""
    positional_encoding: PositionalEncodingDescription | None = None
    """None: the network has no columns for sines and cosines."""
    use_grid: bool = True
    """False: the network has the grid's columns, but they were always fed zeros; no table is stored."""
    contraction: Contraction = "none"
    grid_radius: Annotated[float, Gt(0), Le(1e6)] = 2.0
    """The grid covers [-grid_radius, grid_radius]^3."""
    level_mask: Annotated[int, Ge(1), Le(32)] | None = None
    """Levels in use, coarsest first; the features of finer ones are zero. None: all."""

    @property
    def input_width(self) -> int:
        """Columns of the network's first layer: position, sines and cosines, grid features."""
        encodings = (self.positional_encoding, self.hash)
        return 3 + sum(encoding.width for encoding in encodings if encoding is not None)

    def hidden_width(self, tensors: Mapping[str, TensorSpec]) -> int:
        """Columns of the last layer."""
        return tensors[f"layers.{count_layers(tensors) - 1}.weight"].shape[1]

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        layers = count_layers(tensors)
        require_layer_count(layers)
        stored_grid = self.hash if self.use_grid else None
        require_names(tensors, layer_tensor_names(layers) | ({"hash_table"} if stored_grid is not None else set()))
        if stored_grid is not None:
            require_shape(tensors, "hash_table", (stored_grid.entries, stored_grid.features_per_level))
        check_layers(tensors, self.input_width, {SKIP_LAYER: self.input_width})
