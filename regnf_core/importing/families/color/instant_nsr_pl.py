"""instant-nsr-pl's color network: features with the distance among them, direction, unit normal.

A network of tiny-cuda-nn's own (FullyFusedMLP) is one flat vector: matrices without biases, row after row, inputs and
outputs filled up to multiples of sixteen. What fills the inputs up is always one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from regnf_core.importing.arrays import Float32Array, require_shape, tensor_error
from regnf_core.importing.families.color.head import ColorNetwork, Pair, read_network, read_pair, understood
from regnf_core.importing.families.layers import strip_prefix
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import ColorOverrides
from regnf_core.schema.description import DirectionEncoding, NetworkColor

_PREFIX = "model.texture."
_FLAT = "network.params"
_DEGREE = 4
"""Of the spherical harmonics, where nothing else is said: that of all published configurations."""
_BLOCK = 16
_WIDTHS = (64, 32, 128, 16)
"""All that a fully fused network may have, the usual first."""
_MOST_HIDDEN = 8


def has_color(state: Mapping[str, Any]) -> bool:
    """Whether there is a color network. state: of the whole checkpoint."""
    return any(isinstance(key, str) and key.startswith(_PREFIX + "network.") for key in state)


def read_color(
    whole: dict[str, Any], geometry: Mapping[str, Any], last: str, source: TensorSource, overrides: ColorOverrides
) -> tuple[NetworkColor, dict[str, Float32Array]]:
    """The color as it is stored. whole, geometry: the states · last: the name of the geometry's last layer.

    Raises FieldFormatError.
    """
    state = strip_prefix(whole, _PREFIX)
    weight, bias = read_pair(geometry, last, source, None)
    features = len(weight)
    if _FLAT in state:
        degree = _DEGREE if overrides.direction_degree is None else overrides.direction_degree
        inputs = features + (degree**2 + 3 if overrides.inputs != "features" else 0)
        layers = _flat_layers(source.array(_FLAT, state[_FLAT]), inputs, overrides.hidden_width)
    else:
        count = len({key.split(".")[2] for key in state if key.startswith("network.layers.")})
        layers = read_network(state, [f"network.layers.{2 * i}" for i in range(count)], source, None)
    first = layers[0][0]
    direction = first.shape[1] - features - 3
    form = NetworkColor("network", position=False, gradient=None)
    if direction != -3:
        degree = math.isqrt(max(direction, 0))
        understood(
            degree**2 == direction and 1 <= degree <= _DEGREE,
            f"{direction} columns for the direction, expected those of spherical harmonics",
        )
        understood(
            overrides.direction_degree in (None, degree), "the direction's degree differs from the import option"
        )
        encoding = DirectionEncoding("spherical_harmonics", degree)
        form = NetworkColor("network", position=False, direction=encoding, gradient="unit")
    network = ColorNetwork(form, first[:, features:], first[:, :features], tuple(layers))
    return form, network.after((weight, bias))


def _flat_layers(flat: Float32Array, inputs: int, said: int | None) -> list[Pair]:
    """The layers in a flat vector. said: the hidden layers' width. Raises FieldFormatError."""
    require_shape(_FLAT, flat, (None,))
    columns = -(-inputs // _BLOCK) * _BLOCK
    fitting = []
    for width in _WIDTHS if said is None else (said,):
        hidden, rest = divmod(flat.size - width * (columns + _BLOCK), width * width)
        if rest == 0 and 0 <= hidden < _MOST_HIDDEN:
            fitting.append((width, hidden))
    if len(fitting) != 1:
        message = (
            f"{flat.size} numbers of a fully fused network with {inputs} inputs; {len(fitting)} widths are possible"
        )
        raise tensor_error(message, "TENSOR_SHAPE")
    ((width, hidden),) = fitting
    shapes = [(width, columns), *[(width, width)] * hidden, (_BLOCK, width)]
    ends = np.cumsum([rows * wide for rows, wide in shapes])[:-1]
    weights = [part.reshape(shape) for part, shape in zip(np.split(flat, ends), shapes, strict=True)]
    biases = [np.zeros(len(matrix), dtype=np.float32) for matrix in weights]
    biases[0] = np.asarray(weights[0][:, inputs:].astype(np.float64).sum(axis=1), dtype=np.float32)
    weights[0], weights[-1], biases[-1] = weights[0][:, :inputs], weights[-1][:3], biases[-1][:3]
    return list(zip(weights, biases, strict=True))
