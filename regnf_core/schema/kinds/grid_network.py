"""The kind ``grid_network``: position, sines, blobs and a hash grid over a box into one network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

from regnf_core.schema.description import Corner, FieldDescription
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.layers import check_layers, count_layers, layer_tensor_names
from regnf_core.schema.positional_encoding import PositionalEncodingDescription
from regnf_core.schema.tensor_check import TensorSpec, require, require_names, require_shape

_MAX_EDGE = 1e6


@dataclass(frozen=True, kw_only=True)
class GridNetworkDescription(FieldDescription):
    """A field of the grid_network kind; see :class:`regnf_core.fields.grid_network.GridNetworkFunction`."""

    kind: Literal["grid_network"]
    hash: HashGridConfig
    grid_box: tuple[Corner, Corner]
    """Lowest and highest corner of what the grid covers."""
    positional_encoding: PositionalEncodingDescription | None = None
    """None: the network has no columns for sines and cosines."""
    one_blob_bins: Annotated[int, Ge(0), Le(256)] = 0
    """Bins an axis of the one-blob encoding of the place in the box; 0: the network has no columns for them."""
    activation: Literal["softplus", "relu"] = "softplus"
    skip_layer: Annotated[int, Ge(1), Le(32)] | None = None
    """The layer that sees the network's input again."""

    @property
    def input_width(self) -> int:
        """Columns of the network's first layer: position, sines and cosines, blobs, grid features."""
        sines = 0 if self.positional_encoding is None else self.positional_encoding.width
        return 3 + sines + 3 * self.one_blob_bins + self.hash.width

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        sound = all(0.0 < high - low <= _MAX_EDGE for low, high in zip(*self.grid_box, strict=True))
        require(sound, f"grid_box {self.grid_box} is no box")
        layers = count_layers(tensors)
        require(self.skip_layer is None or self.skip_layer < layers, f"there is no layer {self.skip_layer} to skip to")
        require_names(tensors, layer_tensor_names(layers) | {"hash_table"})
        require_shape(tensors, "hash_table", (self.hash.entries, self.hash.features_per_level))
        skips = {} if self.skip_layer is None else {self.skip_layer: self.input_width}
        check_layers(tensors, self.input_width, skips)
