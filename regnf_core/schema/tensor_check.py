"""Checks of stored tensors against a description, by names, types and shapes alone."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass

from regnf_core.errors import FieldFormatError

FLOAT_TYPES = ("F32", "F16")
INTEGER_TYPES = ("I32",)


@dataclass(frozen=True)
class TensorSpec:
    """A stored tensor's shape and its safetensors type name."""

    shape: tuple[int, ...]
    dtype: str


def require(condition: bool, message: str) -> None:
    """Raise FieldFormatError (FIELD_SHAPES_MISMATCH) unless ``condition`` holds."""
    if not condition:
        raise FieldFormatError(message, reason="FIELD_SHAPES_MISMATCH")


def require_names(tensors: Mapping[str, TensorSpec], names: Set[str], integers: Set[str] = frozenset()) -> None:
    """Exactly these tensors, all of them real numbers but those in ``integers``, which are whole ones.

    Raises FieldFormatError (FIELD_SHAPES_MISMATCH).
    """
    require(set(tensors) == names, f"unexpected or missing tensors: {sorted(names ^ set(tensors))[:4]}")
    for name, spec in sorted(tensors.items()):
        types = INTEGER_TYPES if name in integers else FLOAT_TYPES
        require(spec.dtype in types, f"{name} is {spec.dtype}, expected one of {types}")


def require_shape(tensors: Mapping[str, TensorSpec], name: str, expected: tuple[int, ...]) -> None:
    """Raise FieldFormatError (FIELD_SHAPES_MISMATCH) unless the tensor ``name`` has this shape."""
    shape = tensors[name].shape
    require(shape == expected, f"{name} has shape {shape}; its description requires {expected}")


def count_rows(tensors: Mapping[str, TensorSpec], name: str) -> int:
    """The first extent of the tensor ``name``. Raises FieldFormatError (FIELD_SHAPES_MISMATCH) where there is none."""
    shape = tensors[name].shape
    rows = shape[0] if shape else 0
    require(rows >= 1, f"{name} has no rows")
    return rows


# The linear layers of a stored network: the tensors ``layers.{i}.weight`` (out, in) and ``layers.{i}.bias`` (out,).

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
