"""The color network of sdfstudio and nerfstudio: position, direction, gradient, features, appearance embedding.

Of the appearance the trainers evaluate with zeros, or with the mean over all images where the settings say so.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from regnf_core.importing.arrays import Float32Array, require_shape
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
from regnf_core.importing.upload_description import ColorOverrides
from regnf_core.schema.description import DirectionEncoding, NetworkColor

_PADDING = 1e-3
"""sdfstudio's ``rgb_padding``; nerfstudio has none."""
_EMBEDDING = "embedding_appearance.embedding.weight"
_OTHER_HEADS = ("diffuse_color_pred.", "specular_tint_pred.")


def has_color(state: Mapping[str, Any]) -> bool:
    """Whether there is a color network."""
    return any(key.startswith("clin") for key in state)


def read_color(
    state: Mapping[str, Any], last: str, source: TensorSource, overrides: ColorOverrides, nerfstudio: bool
) -> tuple[NetworkColor, dict[str, Float32Array]]:
    """The color as it is stored. last: the name of the geometry's last layer. Raises FieldFormatError."""
    others = [head for head in _OTHER_HEADS if any(key.startswith(head) for key in state)]
    understood(not others, f"a color of several parts ({', '.join(others)})")
    layers = read_network(state, layer_names(state, "clin", minimum=1), source)
    weight, bias = read_pair(state, last, source)
    first, features = layers[0][0], len(weight) - 1
    embedding = _embedding(state, source)
    spare = first.shape[1] - 6 - features
    widths = [spare - columns for columns in (embedding.shape[1], 0) if (spare - columns) % 6 == 3 <= spare - columns]
    understood(bool(widths), f"{first.shape[1]} inputs; expected position, direction, gradient, features, appearance")
    degree = degree_of(widths[0], overrides.direction_degree)
    padding = 0.0 if nerfstudio else _PADDING if overrides.padding is None else overrides.padding
    form = NetworkColor(
        "network", direction=DirectionEncoding("frequency", degree, nerfstudio), gradient="raw", padding=padding
    )
    direction = 3 + our_order(degree, "kind", direction_first=False)
    gradient = 3 + widths[0]
    own = first[:, np.concatenate((np.arange(3), direction, gradient + np.arange(3)))]
    start = gradient + 3
    if overrides.average_appearance and widths[0] != spare:
        layers[0] = _with_mean(layers[0], start + features, embedding)
    network = ColorNetwork(form, own, first[:, start : start + features], tuple(layers))
    return form, network.after((weight[1:], bias[1:]))


def assumed_of(state: Mapping[str, Any], overrides: ColorOverrides) -> str | None:
    """What :func:`read_color` takes for granted of such a color, in words. (The padding is a thousandth.)"""
    if _EMBEDDING not in state or overrides.average_appearance is not None:
        return None
    return (
        "the appearance embedding is assumed to be zero (use_average_appearance_embedding false). If the trainer "
        "uses the mean, give the import option color.average_appearance: true, or the trainer's config file"
    )


def _embedding(state: Mapping[str, Any], source: TensorSource) -> Float32Array:
    """One row an image; without columns where there is none."""
    if _EMBEDDING not in state:
        return np.zeros((1, 0), dtype=np.float32)
    rows = source.array(_EMBEDDING, state[_EMBEDDING])
    require_shape(_EMBEDDING, rows, (None, None))
    return rows


def _with_mean(layer: Pair, start: int, embedding: Float32Array) -> Pair:
    """The layer whose columns from ``start`` on are always given the embedding's mean."""
    weight, bias = layer
    mean = embedding.astype(np.float64).mean(axis=0)
    return weight, np.asarray(bias + weight[:, start:].astype(np.float64) @ mean, dtype=np.float32)
