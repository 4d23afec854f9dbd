"""Co-SLAM (Wang et al. 2023): [grid(u), one blob(u)] into ReLU layers without biases, u the place in the scene's box.

The result times the truncation is the distance, as far as the truncation. Neither it nor the box is in the checkpoint:
the run's config.json has both.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import require_shape, tensor_error
from regnf_core.importing.families.color.head import without_color
from regnf_core.importing.families.converted import ConvertedField, converted_of
from regnf_core.importing.families.grid_search import GridHabits, find_spaces, space_readings
from regnf_core.importing.families.layers import (
    Layers,
    contradiction,
    read_layers,
    refuse_other_entries,
    require_extra_columns,
    require_family,
    shared_entries,
    strip_prefix,
)
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import GridDescription, UploadDescription

FAMILY = "co_slam"
_NETWORK, _TABLE, _COLORS = "decoder.sdf_net.model.", "embed_fn.params", "decoder.color_net."
_LEVELS, _FEATURES, _BASE = 16, 2, 16
"""No setting of the trainer changes these."""
_HABITS = GridHabits((_FEATURES,), "linear")
_MAX_BINS = 256


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The truncated signed distance field of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, LAYOUT_AMBIGUOUS (nothing says the box and the truncation),
    TENSOR_MISSING, TENSOR_SHAPE, HASH_GRID_NOT_RECOGNIZED, SETTINGS_CONTRADICT_TENSORS and what TensorSource raises.
    """
    model = checkpoint.get("model")
    state = next((s for s in (strip_prefix(model, p) for p in ("module.", "")) if strip_prefix(s, _NETWORK)), None)
    if state is None:
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("hash", "grid_box", "truncation"))
    layers = _layers(state, source)
    table = source.array(_TABLE, lookup(state, _TABLE))
    require_shape(_TABLE, table, (None,))
    given = _always(overrides)
    width = _LEVELS * _FEATURES
    bins, rest = divmod(layers.input_width - width, 3)
    if rest or not 1 <= bins <= _MAX_BINS:
        columns = f"{layers.input_width} columns, expected {width} of the grid and 3 x bins"
        raise tensor_error(f"{_NETWORK}0 has {columns}", "TENSOR_SHAPE")
    if overrides.grid_box is None or overrides.truncation is None:
        message = (
            "a checkpoint of Co-SLAM has neither the scene's box nor the truncation: give its run's config.json too,"
            ' or say {"grid_box": mapping.bound as two corners, "truncation": training.trunc, "hash":'
            ' {"log2_table_size": grid.hash_size, "top_resolution": longest edge / grid.voxel_sdf}} in the description'
        )
        raise FieldFormatError(message, reason="LAYOUT_AMBIGUOUS")
    entries = {
        "kind": "grid_network",
        **shared_entries(overrides, overrides.grid_box),
        "grid_box": overrides.grid_box,
        "one_blob_bins": bins,
        "activation": "relu",
        "source": {"family": FAMILY},
    }
    spaces = find_spaces(table.size, width, _HABITS, given)
    tensors = _in_our_order(layers, width).times(overrides.truncation).tensors()
    why = (
        f"keys {_NETWORK}*, {len(layers.weights)} layers, {bins} bins an axis",
        f"distances are the network's results times {overrides.truncation:g}, and no distances beyond that",
    )
    converted = converted_of(FAMILY, why, space_readings(table, spaces, tensors, entries))
    colors = [name for name in state if name.startswith(_COLORS)] if overrides.color.keep is not False else []
    return without_color(converted, colors, "Co-SLAM")


def _always(overrides: UploadDescription) -> GridDescription:
    """What is said of the grid, with what holds for every one of theirs."""
    given = overrides.hash
    for name, value in (("levels", _LEVELS), ("features_per_level", _FEATURES), ("base_resolution", _BASE)):
        if getattr(given, name) not in (None, value):
            raise contradiction(f"hash.{name}", getattr(given, name), value)
    return replace(
        given,
        levels=_LEVELS,
        features_per_level=_FEATURES,
        base_resolution=_BASE,
        interpolation=given.interpolation or "linear",
    )


def _layers(state: dict[str, Any], source: TensorSource) -> Layers:
    """Linear layers have the even numbers; ReLU between them has the odd ones."""
    parts = {key.split(".")[0] for key in strip_prefix(state, _NETWORK)}
    numbers = sorted(int(part) for part in parts if part.isdecimal())
    if len(numbers) < 2 or numbers != list(range(0, 2 * len(numbers), 2)):
        message = "Co-SLAM with a network of tiny-cuda-nn's own (tcnn_network): extract its mesh, and give that"
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
    names = [f"{_NETWORK}{number}" for number in numbers]
    layers = read_layers(state, names, source, has_biases=None)
    require_extra_columns(layers, names)
    return layers


def _in_our_order(layers: Layers, width: int) -> Layers:
    """[position (which is not fed), blobs, grid] for the trainer's [grid, blobs]."""
    first = layers.weights[0]
    columns = (np.zeros((len(first), 3), dtype=np.float32), first[:, width:], first[:, :width])
    return Layers((np.concatenate(columns, axis=1), *layers.weights[1:]), layers.biases)
