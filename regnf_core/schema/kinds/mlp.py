"""The kind ``mlp``: the position, with or without its sines and cosines, into a network of plain layers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Ge, Le, MaxLen

from regnf_core.schema.kinds.kind import FieldDescription
from regnf_core.schema.kinds.neus_facto import MAX_LAYERS, PositionalEncodingDescription
from regnf_core.schema.tensor_check import TensorSpec, count_rows, require, require_names, require_shape

if TYPE_CHECKING:
    from torch import Tensor

    from regnf_core.fields.function_field import FunctionField
    from regnf_core.fields.mlp import MlpFunction

ActivationName = Literal["relu", "softplus", "sine"]
LayerNumbers = Annotated[tuple[Annotated[int, Ge(0), Le(MAX_LAYERS)], ...], MaxLen(MAX_LAYERS)]


@dataclass(frozen=True, kw_only=True)
class MlpDescription(FieldDescription):
    """A field of the mlp kind; see :class:`regnf_core.fields.mlp.MlpFunction`."""

    family: Literal["mlp"]
    activation: ActivationName
    """Between layers; softplus is log(1 + exp(100 a)) / 100."""
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

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        layers = count_layers(tensors)
        require(1 <= layers <= MAX_LAYERS, f"the field has {layers} layers, expected 1 to {MAX_LAYERS}")
        require(all(0 < i < layers for i in self.input_at), "input_at names a layer that is not there, or the first")
        require(all(i < layers - 1 for i in self.normalized), "normalized names a layer that is not there, or the last")
        names = {f"layers.{i}.{part}" for i in range(layers) for part in ("weight", "bias")}
        require_names(tensors, names | {f"norms.{i}.{part}" for i in self.normalized for part in ("weight", "bias")})
        width = self.input_width
        for layer in range(layers):
            if layer in self.input_at:
                width += self.input_width
            rows = count_rows(tensors, f"layers.{layer}.weight")
            require_shape(tensors, f"layers.{layer}.weight", (rows, width))
            require_shape(tensors, f"layers.{layer}.bias", (rows,))
            if layer in self.normalized:
                require_shape(tensors, f"norms.{layer}.weight", (rows,))
                require_shape(tensors, f"norms.{layer}.bias", (rows,))
            width = rows

    def build(self, tensors: Mapping[str, Tensor]) -> FunctionField[MlpFunction]:
        """The network as a field."""
        from regnf_core.fields.mlp import build_mlp

        return build_mlp(self, tensors)


def check_plain_layers(tensors: Mapping[str, TensorSpec], width: int) -> None:
    """Raise FieldFormatError (FIELD_SHAPES_MISMATCH) unless the layers take ``width`` columns and follow one another.

    The tensors' names must have been checked.
    """
    layers = count_layers(tensors)
    require(1 <= layers <= MAX_LAYERS, f"the field has {layers} layers, expected 1 to {MAX_LAYERS}")
    for layer in range(layers):
        rows = count_rows(tensors, f"layers.{layer}.weight")
        require_shape(tensors, f"layers.{layer}.weight", (rows, width))
        require_shape(tensors, f"layers.{layer}.bias", (rows,))
        width = rows


def count_layers(names: Mapping[str, object]) -> int:
    """How many layers' weights there are."""
    return sum(name.startswith("layers.") and name.endswith(".weight") for name in names)
