"""torch-ngp's fields of meshes: a hash grid over [-1, 1]^3 and a ReLU network without biases.

There are two ways in which the trainer evaluates the grid: its own kernel, whose file tells where each level begins,
and tiny-cuda-nn, whose file holds two bare vectors of numbers.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, require_shape, tensor_error
from regnf_core.importing.families.converted import ConvertedField, Reading, converted_of
from regnf_core.importing.families.grid_search import GridHabits, find_spaces, most_usual, space_readings
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    Layers,
    contradiction,
    layer_names,
    read_layers,
    refuse_other_entries,
    require_extra_columns,
    require_family,
    shared_entries,
    strip_prefix,
)
from regnf_core.importing.families.offset_grids import not_recognized, offset_readings, read_table
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import GridDescription, UploadDescription

FAMILY = "torch_ngp"
_OWN, _TCNN = ("encoder.embeddings", "encoder.offsets", "backbone.0.weight"), ("encoder.params", "backbone.params")
_HABITS = GridHabits((2, 4, 1, 8), "linear", writes_growth=True)
_NEURONS = (64, 128, 32, 16)
_MAX_HIDDEN = 8
_USUAL_WIDTHS = (32, 16, 64, 128, 8)
_MAX_WIDTH = 256
_MAX_LOG2_SIZE = 24
_PADDING = 16
"""tiny-cuda-nn's fused network takes and gives this many columns, or a multiple."""


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, INVALID_DESCRIPTION, TENSOR_MISSING, TENSOR_SHAPE,
    HASH_GRID_NOT_RECOGNIZED and what TensorSource raises.
    """
    state = strip_prefix(checkpoint.get("model", checkpoint), "")
    own = all(name in state for name in _OWN)
    if not own and not all(name in state for name in _TCNN):
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("hash",))
    entries = {
        "kind": "grid_mlp",
        **shared_entries(overrides, UNIT_CUBE),
        "grid_radius": overrides.hash.radius or 1.0,
        "source": {"family": FAMILY},
    }
    read = _read_own if own else _read_tcnn
    readings, layers = read(state, source, entries, overrides.hash)
    told = "encoder.embeddings with offsets" if own else "encoder.params, backbone.params"
    why = (f"keys {told}, {layers} layers", "bounds [-1, 1]: the cube in which it trains")
    converted = converted_of(FAMILY, why, readings)
    return replace(converted, sign_is_open=True)


_Found = tuple[tuple[Reading, ...], int]
"""The readings, and the number of layers."""


def _read_own(state: dict[str, Any], source: TensorSource, entries: dict[str, Any], given: GridDescription) -> _Found:
    """The possible functions of the trainer's own kernel."""
    names = layer_names(state, "backbone.")
    layers = read_layers(state, names, source, has_biases=False)
    require_extra_columns(layers, names)
    table = read_table(state, source, "encoder.", given)
    if layers.input_width != table.width:
        message = f"{table.width} columns of the grid, but the network has {layers.input_width}"
        raise tensor_error(message, "TENSOR_SHAPE")
    return offset_readings(table, layers.tensors(), entries, given), len(layers.weights)


def _read_tcnn(state: dict[str, Any], source: TensorSource, entries: dict[str, Any], given: GridDescription) -> _Found:
    """The possible functions of tiny-cuda-nn's encoding and fused network."""
    table = source.array("encoder.params", lookup(state, "encoder.params"))
    network = source.array("backbone.params", lookup(state, "backbone.params"))
    for name, vector in (("encoder.params", table), ("backbone.params", network)):
        require_shape(name, vector, (None,))
    readings: list[Reading] = []
    count = 0
    for width, neurons in itertools.product(_widths(given), _NEURONS):
        if readings and width not in _USUAL_WIDTHS:
            break
        layers = _split(network, width, neurons)
        if layers is None:
            continue
        with contextlib.suppress(FieldFormatError):
            spaces = find_spaces(table.size, width, _HABITS, given)
            readings += space_readings(table, spaces, layers.tensors(), entries)
            count = len(layers.weights)
    if not readings:
        if given != GridDescription():
            raise contradiction("hash", given, f"{table.size} and {network.size} numbers")
        raise not_recognized(f"no grid and network have {table.size} and {network.size} parameters")
    return most_usual(readings), count


def _widths(given: GridDescription) -> Sequence[int]:
    """How wide the encoding may be, the usual widths first."""
    if given.levels is not None and given.features_per_level is not None:
        return (given.levels * given.features_per_level,)
    return tuple(dict.fromkeys((*_USUAL_WIDTHS, *range(2, _MAX_WIDTH + 1))))


def _split(network: Float32Array, width: int, neurons: int) -> Layers | None:
    """The fused network's layers, row-major and without biases; None where no usual network has that size.

    Columns beyond ``width`` are always fed ones, so they are a bias; of the result only row 0 is used.
    """
    padded = -(-width // _PADDING) * _PADDING
    hidden, rest = divmod(network.size - (padded + _PADDING) * neurons, neurons * neurons)
    if rest or not 0 <= hidden < _MAX_HIDDEN:
        return None
    shapes = [(neurons, padded), *[(neurons, neurons)] * hidden, (_PADDING, neurons)]
    ends = np.cumsum([rows * columns for rows, columns in shapes])[:-1]
    weights = [part.reshape(shape) for part, shape in zip(np.split(network, ends), shapes, strict=True)]
    biases = [np.zeros(rows, dtype=np.float32) for rows, _ in shapes]
    biases[0] = weights[0][:, width:].sum(axis=1, dtype=np.float32)
    weights[0] = np.ascontiguousarray(weights[0][:, :width])
    return Layers((*weights[:-1], weights[-1][:1]), (*biases[:-1], biases[-1][:1]))
