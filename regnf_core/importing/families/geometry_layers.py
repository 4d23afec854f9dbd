"""The geometry network of sdfstudio's and nerfstudio's fields: layers glin0, glin1 ..., weight norm folded in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.fields.kinds.neus_facto import MAX_LAYERS, SKIP_LAYER
from regnf_core.importing.tensors import Float32Array, TensorSource, lookup, require_shape


@dataclass(frozen=True)
class GeometryLayers:
    """weights[i]: (out_i, in_i), biases[i]: (out_i,). Of the last layer only the first row is kept: the distance."""

    weights: tuple[Float32Array, ...]
    biases: tuple[Float32Array, ...]

    @property
    def input_width(self) -> int:
        """Columns of the first layer."""
        return int(self.weights[0].shape[1])

    def uses_columns(self, start: int, stop: int | None) -> bool:
        """Whether these columns of the input have any weight: unused encodings keep the zeros they began with."""
        seen = [self.weights[0]]
        if len(self.weights) > SKIP_LAYER:
            seen.append(self.weights[SKIP_LAYER][:, -self.input_width :])
        return any(bool(weight[:, start:stop].any()) for weight in seen)

    def tensors(self) -> dict[str, Float32Array]:
        """The layers under the names of the safe field file."""
        named = {f"layers.{i}.weight": weight for i, weight in enumerate(self.weights)}
        return named | {f"layers.{i}.bias": bias for i, bias in enumerate(self.biases)}


def count_layers(state: dict[str, Any]) -> int:
    """How many layers there are. Raises FieldFormatError: TENSOR_MISSING (a gap) or FAMILY_NOT_SUPPORTED (too few)."""
    numbers = {key.removeprefix("glin").split(".")[0] for key in state if key.startswith("glin")}
    layers = len(numbers)
    if layers > MAX_LAYERS or numbers != {str(i) for i in range(layers)}:
        raise FieldFormatError("the geometry network's layers are not numbered from 0 on", reason="TENSOR_MISSING")
    if layers < 2:
        raise FieldFormatError("a geometry network of one layer", reason="FAMILY_NOT_SUPPORTED")
    return layers


def read_layers(state: dict[str, Any], source: TensorSource) -> GeometryLayers:
    """All layers, their shapes checked against each other.

    Raises FieldFormatError: TENSOR_MISSING, TENSOR_SHAPE, FAMILY_NOT_SUPPORTED and what TensorSource raises.
    """
    layers = count_layers(state)
    weights, biases = [], []
    inputs = width = 0
    for layer in range(layers):
        weight = _folded_weight(state, f"glin{layer}", source)
        inputs = inputs or weight.shape[1]
        expected = (width + (inputs if layer == SKIP_LAYER else 0)) or inputs
        require_shape(f"glin{layer}", weight, (None, expected))
        bias = source.array(f"glin{layer}.bias", lookup(state, f"glin{layer}.bias"))
        require_shape(f"glin{layer}.bias", bias, (weight.shape[0],))
        rows = slice(0, 1) if layer == layers - 1 else slice(None)
        weights.append(weight[rows])
        biases.append(bias[rows])
        width = weight.shape[0]
    return GeometryLayers(tuple(weights), tuple(biases))


def _folded_weight(state: dict[str, Any], name: str, source: TensorSource) -> Float32Array:
    """W = g v / |v|, row by row; or the plain weight of a network without weight normalisation."""
    if f"{name}.weight" in state:
        weight = source.array(f"{name}.weight", state[f"{name}.weight"])
        require_shape(f"{name}.weight", weight, (None, None))
        return weight
    direction = source.array(f"{name}.weight_v", lookup(state, f"{name}.weight_v"))
    require_shape(f"{name}.weight_v", direction, (None, None))
    length = source.array(f"{name}.weight_g", lookup(state, f"{name}.weight_g"))
    require_shape(f"{name}.weight_g", length, (direction.shape[0], 1))
    norm = np.linalg.norm(direction.astype(np.float64), axis=1, keepdims=True)
    if not norm.all():
        raise FieldFormatError(f"a row of {name}.weight_v is zero and has no direction", reason="TENSOR_NOT_FINITE")
    return np.asarray(length * (direction / norm), dtype=np.float32)
