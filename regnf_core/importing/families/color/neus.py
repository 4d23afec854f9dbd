"""NeuS's color network: position, direction, gradient, features.

Its trainer reads and writes images as B, G, R; ours are R, G, B.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from regnf_core.importing.arrays import Float32Array
from regnf_core.importing.families.color.head import (
    ColorNetwork,
    Pair,
    degree_of,
    our_order,
    read_network,
    read_pair,
    understood,
)
from regnf_core.importing.families.layers import layer_names
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import ColorOverrides, Inputs
from regnf_core.schema.description import DirectionEncoding, NetworkColor


def read_color(
    state: Mapping[str, Any], geometry: Mapping[str, Any], last: str, source: TensorSource, overrides: ColorOverrides
) -> tuple[NetworkColor, dict[str, Float32Array]]:
    """The color as it is stored. geometry: the state of the geometry, ``last`` its last layer's name.

    Raises FieldFormatError.
    """
    layers = read_network(state, layer_names(state, "lin", minimum=1), source)
    weight, bias = read_pair(geometry, last, source)
    first, features = layers[0][0], len(weight) - 1
    between = first.shape[1] - 3 - features
    inputs = _inputs(between, overrides.inputs)
    direction, columns = None, np.arange(3)
    if inputs != "no_direction":
        width = between - (3 if inputs == "all" else 0)
        degree = degree_of(width, overrides.direction_degree)
        direction = DirectionEncoding("frequency", degree)
        columns = np.concatenate((columns, 3 + our_order(degree, "frequency", direction_first=True)))
    if inputs != "no_gradient":
        columns = np.concatenate((columns, between + np.arange(3)))
    form = NetworkColor(
        "network",
        direction=direction,
        gradient=None if inputs == "no_gradient" else "raw",
        output=overrides.output or "sigmoid",
    )
    if overrides.channels != "rgb":
        layers[-1] = _reversed(layers[-1])
    network = ColorNetwork(form, first[:, columns], first[:, 3 + between :], tuple(layers))
    return form, network.after((weight[1:], bias[1:]))


def _inputs(columns: int, said: Inputs | None) -> Inputs:
    """What stands between position and features: NeuS's modes ``idr``, ``no_view_dir`` and ``no_normal``."""
    if said is not None:
        return said
    understood(columns != 3, "three columns between position and features, of the direction or of the gradient")
    return "no_gradient" if columns % 6 == 3 else "all"


def _reversed(layer: Pair) -> Pair:
    return np.ascontiguousarray(layer[0][::-1]), np.ascontiguousarray(layer[1][::-1])
