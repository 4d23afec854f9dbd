"""The linear layers of a stored network: the tensors ``layers.{i}.weight`` (out, in) and ``layers.{i}.bias`` (out,)."""

from __future__ import annotations

from collections.abc import Mapping

from regnf_core.schema.tensor_check import TensorSpec, count_rows, require, require_shape

MAX_LAYERS = 32


def count_layers(names: Mapping[str, object]) -> int:
    """Return the number of layers, from the names of their weights."""
    return sum(name.startswith("layers.") and name.endswith(".weight") for name in names)


def layer_tensor_names(layers: int) -> set[str]:
    """Return the names of the tensors of so many layers."""
    return {f"layers.{i}.{part}" for i in range(layers) for part in ("weight", "bias")}


def require_layer_count(layers: int) -> None:
    """Raise FieldFormatError (FIELD_SHAPES_MISMATCH) unless there are 1 to MAX_LAYERS layers."""
    require(1 <= layers <= MAX_LAYERS, f"the field has {layers} layers, expected 1 to {MAX_LAYERS}")


def check_layers(tensors: Mapping[str, TensorSpec], width: int, extra_columns: Mapping[int, int] | None = None) -> None:
    """Raise FieldFormatError (FIELD_SHAPES_MISMATCH) unless each layer continues the one before.

    width: columns of the first layer. extra_columns: by layer, how many columns it has beyond the rows of the layer
    before (a skip connection). The names of the tensors must have been checked.
    """
    layers = count_layers(tensors)
    require_layer_count(layers)
    for layer in range(layers):
        width += (extra_columns or {}).get(layer, 0)
        rows = count_rows(tensors, f"layers.{layer}.weight")
        require_shape(tensors, f"layers.{layer}.weight", (rows, width))
        require_shape(tensors, f"layers.{layer}.bias", (rows,))
        width = rows
