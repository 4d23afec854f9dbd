"""A trainer's color network, made to follow what the stored geometry computes, and put beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, StoredArray, require_shape, tensor_error
from regnf_core.importing.families.converted import ConvertedField, Reading
from regnf_core.importing.families.layers import folded_weight
from regnf_core.importing.families.network import Order, encoding_order
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.schema.description import COLOR, VALUES, NetworkColor, ValueColor, color_tensors
from regnf_core.schema.tensor_check import MAX_LAYERS

LEFT_OUT = "COLOR_LEFT_OUT"
"""The word of the warning that a file has a color which is not kept."""
ASSUMED = "COLOR_ASSUMED"
"""The word of the warning that a color is kept whose settings nobody has said: it may be somewhat off."""
_MOST_PRODUCTS = 1 << 31
"""Multiplications for joining two layers: a few seconds."""
_DEVIATIONS = (1e-6, 1e6)
"""The trainers clamp NeuS's s to these."""

_FIRST = f"{COLOR}.layers.0.weight"
Pair = tuple[Float32Array, Float32Array]
"""A layer's weight (out, in) and bias (out,)."""
ReadColor = tuple[NetworkColor, dict[str, Float32Array]]
"""The color's form, and its tensors by their names in the file."""


@dataclass(frozen=True)
class ColorNetwork:
    """form: its inputs, in our order · own: (out, own columns) of the first layer, for these · features: (out, F), for
    the geometry's results · layers: all of them; of the first one's weight nothing else is used."""

    form: NetworkColor
    own: Float32Array
    features: Float32Array
    layers: tuple[Pair, ...]

    def after(self, last: Pair) -> dict[str, Float32Array]:
        """The tensors of the network that sees what the geometry's last layer sees.

        last: that layer's rows for the features. No activation stands between it and the color's first layer, so that
        they are one. Raises FieldFormatError (TENSOR_SHAPE, TENSOR_TOO_LARGE, TENSOR_NOT_FINITE).
        """
        weight, bias = last
        if weight.shape[0] != self.features.shape[1]:
            raise tensor_error(
                f"the color network uses {self.features.shape[1]} of {weight.shape[0]} features", "TENSOR_SHAPE"
            )
        if self.features.shape[0] * weight.size > _MOST_PRODUCTS:
            raise tensor_error("the first layer of the color network is too large", "TENSOR_TOO_LARGE")
        features = self.features.astype(np.float64)
        first = np.concatenate((self.own, features @ weight.astype(np.float64)), axis=1)
        moved = self.layers[0][1] + features @ bias.astype(np.float64)
        with np.errstate(over="ignore"):
            layers = ((first.astype(np.float32), moved.astype(np.float32)), *self.layers[1:])
        named = {f"layers.{i}.weight": pair[0] for i, pair in enumerate(layers)}
        named |= {f"layers.{i}.bias": pair[1] for i, pair in enumerate(layers)}
        if not all(np.isfinite(array).all() for array in named.values()):
            raise tensor_error("the first layer of the color network has NaN or infinity", "TENSOR_NOT_FINITE")
        return color_tensors(named)


def read_network(
    state: Mapping[str, Any], names: Sequence[str], source: TensorSource, biases: bool | None = True
) -> list[Pair]:
    """The layers of these names, each of which must continue the one before, the last giving three numbers.

    biases: None where each layer's names tell whether it has one. Raises FieldFormatError (TENSOR_*).
    """
    if not 1 <= len(names) <= MAX_LAYERS:
        raise tensor_error(f"a color network of {len(names)} layers", "TENSOR_MISSING")
    layers = [read_pair(state, name, source, biases) for name in names]
    for name, before, after in zip(names[1:], layers, layers[1:], strict=False):
        require_shape(name, after[0], (None, before[0].shape[0]))
    require_shape(names[-1], layers[-1][0], (3, None))
    return layers


def read_pair(state: Mapping[str, Any], name: str, source: TensorSource, biases: bool | None = True) -> Pair:
    """The whole layer ``name``: weight and bias, zeros where it has none. Raises FieldFormatError (TENSOR_*)."""
    weight = folded_weight(state, name, source)
    bias = np.zeros(len(weight), dtype=np.float32)
    if biases or (biases is None and f"{name}.bias" in state):
        if f"{name}.bias" not in state:
            raise tensor_error(f"{name}.bias is missing", "TENSOR_MISSING")
        bias = source.array(f"{name}.bias", state[f"{name}.bias"])
        require_shape(f"{name}.bias", bias, (len(weight),))
    return weight, bias


def with_color(converted: ConvertedField, read: Callable[[], ReadColor], hidden_factor: float = 1.0) -> ConvertedField:
    """``converted``, all its readings too, with the color that ``read`` gives; a warning where it gives none.

    hidden_factor: what the trainer's last layer is given, over what the stored one is. The geometry matters more: no
    fault of a color makes an import fail.
    """
    try:
        form, tensors = read()
    except FieldFormatError as error:
        return _warned(converted, error)
    layers = sum(name.endswith(".weight") for name in tensors)
    return replace(
        _added(converted, {COLOR: asdict(form)}, _scaled(form.own_width, tensors, hidden_factor)),
        why=(*converted.why, f"color: a network of {layers} layers, stored with the geometry"),
    )


def without_color(converted: ConvertedField, keys: Sequence[str], family: str) -> ConvertedField:
    """``converted`` with the warning COLOR_LEFT_OUT, if the file has a color that is not read, under ``keys``."""
    return (
        _warned(converted, f"{keys[0]}: colors of {family} are not read; only the geometry is imported")
        if keys
        else converted
    )


def _warned(converted: ConvertedField, why: object) -> ConvertedField:
    return replace(converted, warnings=(*converted.warnings, f"{LEFT_OUT}: {why}"))


def with_hidden_factor(reading: Reading, hidden_width: int, factor: float) -> Reading:
    """``reading``, if it has color, after the numbers that its last layer is given were divided by ``factor``."""
    if _FIRST not in reading.tensors:
        return reading
    own_width = reading.tensors[_FIRST].shape[1] - hidden_width
    return replace(reading, tensors=_scaled(own_width, reading.tensors, factor))


def with_values(converted: ConvertedField, read: Callable[[], StoredArray | None]) -> ConvertedField:
    """``converted`` with colors at its vertices or nodes, if ``read`` gives any; a warning where it raises."""
    try:
        values = read()
    except FieldFormatError as error:
        return _warned(converted, error)
    if values is None:
        return converted
    colored = _added(converted, {COLOR: asdict(ValueColor("values"))}, color_tensors({VALUES: values}))
    return replace(colored, why=(*converted.why, "colors are imported"))


def with_deviation(
    converted: ConvertedField, state: Mapping[str, Any], name: str, source: TensorSource
) -> ConvertedField:
    """``converted`` with NeuS's s = exp(10 v), of the number v under ``name``, where there is one."""
    try:
        values = source.array(name, state[name]) if name in state else np.zeros(0)
    except FieldFormatError:  # it is no part of the geometry
        return converted
    if values.size != 1:
        return converted
    exponent = np.clip(10.0 * float(values.reshape(())), *np.log(_DEVIATIONS))
    return _added(converted, {"inverse_deviation": float(np.exp(exponent))}, {})


def _scaled(own_width: int, tensors: Mapping[str, Any], factor: float) -> dict[str, Any]:
    first = np.array(tensors[_FIRST], dtype=np.float32)
    first[:, own_width:] *= np.float32(factor)
    return {**tensors, _FIRST: first}


def understood(condition: bool, message: str) -> None:
    """Raise FieldFormatError (FAMILY_NOT_SUPPORTED) unless ``condition`` holds: the color is of a form not known."""
    if not condition:
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")


def _added(converted: ConvertedField, entries: Mapping[str, Any], tensors: Mapping[str, StoredArray]) -> ConvertedField:
    def added(reading: Reading) -> Reading:
        description, stored = {**reading.description, **entries}, {**reading.tensors, **tensors}
        return replace(reading, description=description, tensors=stored)

    return replace(
        converted,
        description={**converted.description, **entries},
        tensors={**converted.tensors, **tensors},
        readings=tuple(map(added, converted.readings)),
    )


# The columns of a direction's sines and cosines: how many there are, and in which order we keep them.

MAX_DEGREE = 24


def degree_of(columns: int, said: int | None = None) -> int:
    """Frequencies of a direction's encoding with so many columns: the direction and its sines and cosines.

    Raises FieldFormatError (FAMILY_NOT_SUPPORTED) for columns of anything else, or another number than was said.
    """
    degree, rest = divmod(columns - 3, 6)
    understood(
        rest == 0 and 0 <= degree <= MAX_DEGREE, f"{columns} columns for the direction, expected 3 + 6 per frequency"
    )
    understood(said in (None, degree), f"{degree} frequencies of the direction, the import options have {said}")
    return degree


def our_order(degree: int, order: Order, direction_first: bool) -> npt.NDArray[np.int64]:
    """Where in the trainer's columns each of ours is: direction, sines, cosines."""
    sines = encoding_order(order, degree, 6 * degree)
    if direction_first:
        return np.concatenate((np.arange(3), 3 + sines))
    return np.concatenate((6 * degree + np.arange(3), sines))
