"""The kind ``mlp``: the position, with or without its sines and cosines, into a network of plain layers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le, MaxLen

from regnf_core.schema.description import FieldDescription
from regnf_core.schema.layers import MAX_LAYERS, check_layers, count_layers, layer_tensor_names, require_layer_count
from regnf_core.schema.positional_encoding import PositionalEncodingDescription
from regnf_core.schema.tensor_check import TensorSpec, count_rows, require, require_names, require_shape

LEAKY_SLOPE = 0.01
"""Of leaky_relu for negative numbers, where nothing else is said."""

ActivationName = Literal["relu", "softplus", "sine", "tanh", "elu", "gelu", "silu", "leaky_relu"]
LayerNumbers = Annotated[tuple[Annotated[int, Ge(0), Le(MAX_LAYERS)], ...], MaxLen(MAX_LAYERS)]


@dataclass(frozen=True, kw_only=True)
class MlpDescription(FieldDescription):
    """A field of the mlp kind; see :class:`regnf_core.fields.mlp.MlpFunction`."""

    kind: Literal["mlp"]
    activation: ActivationName
    """Between layers; softplus is log(1 + exp(100 a)) / 100, gelu the exact one."""
    negative_slope: Annotated[float, Ge(0), Le(1)] = LEAKY_SLOPE
    """Of leaky_relu for negative numbers."""
    positional_encoding: PositionalEncodingDescription | None = None
    """None: the network sees the position alone."""
    input_at: LayerNumbers = ()
    """Layers, not the first, that see [hidden, input]."""
    normalized: LayerNumbers = ()
    """Layers whose result goes through a layer normalization before the activation."""
    output_tanh: Annotated[int, Ge(0), Le(2)] = 0
    """How often tanh is applied to the last layer's result."""

    @property
    def input_width(self) -> int:
        """Columns of the network's first layer: position, sines and cosines."""
        return 3 + (self.positional_encoding.width if self.positional_encoding is not None else 0)

    def hidden_width(self, tensors: Mapping[str, TensorSpec]) -> int:
        """Columns of the last layer."""
        return tensors[f"layers.{count_layers(tensors) - 1}.weight"].shape[1]

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        layers = count_layers(tensors)
        require_layer_count(layers)
        require(all(0 < i < layers for i in self.input_at), "input_at names the first layer or a missing one")
        require(all(i < layers - 1 for i in self.normalized), "normalized names the last layer or a missing one")
        norms = {f"norms.{i}.{part}" for i in self.normalized for part in ("weight", "bias")}
        require_names(tensors, layer_tensor_names(layers) | norms)
        check_layers(tensors, self.input_width, dict.fromkeys(self.input_at, self.input_width))
        for i in self.normalized:
            rows = count_rows(tensors, f"layers.{i}.weight")
            require_shape(tensors, f"norms.{i}.weight", (rows,))
            require_shape(tensors, f"norms.{i}.bias", (rows,))
