"""Neuralangelo (Li et al. 2023): a hash grid over [-2, 2]^3 and a small network, opened from coarse to fine.

How many levels are open is not saved, but the number of iterations is. Where the formula leaves it open, the table
tells: the features of a level that never opened keep the small random values they began with.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, require_shape
from regnf_core.importing.families.converted import ConvertedField, converted_of
from regnf_core.importing.families.grid_field import space_readings, step_of
from regnf_core.importing.families.grid_search import GridHabits, find_spaces
from regnf_core.importing.families.layers import Layers, layer_names, read_layers, require_extra_columns, strip_prefix
from regnf_core.importing.families.shared import UNIT_CUBE, refuse_other_entries, require_family, shared_entries
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.hash_grid_config import HashGridConfig

FAMILY = "neuralangelo"
_PREFIXES = ("module.neural_sdf.", "neural_sdf.")
_TABLE = "tcnn_encoding.params"
_HABITS = GridHabits((8, 4, 2, 1), "linear")
_WARM_UP, _STEPS_A_LEVEL = 5000, 5000
_FIRST_LEVELS = (4, 8)
"""Levels open from the start: the usual number, and that of the large scenes' configuration."""
_UNTRAINED = 1.01e-4
"""tiny-cuda-nn begins with features between -1e-4 and 1e-4."""
_RADIUS = 2.0
"""Half an edge of the cube that the grid covers, in all published configurations."""


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, TENSOR_MISSING, TENSOR_SHAPE, HASH_GRID_NOT_RECOGNIZED and what
    TensorSource raises.
    """
    model = checkpoint.get("model")
    prefix = next((p for p in _PREFIXES if strip_prefix(model, p)), None)
    if prefix is None:
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("level_mask", "hash"))
    state = strip_prefix(model, prefix)
    layers = _layers(state, source)
    table = source.array(_TABLE, lookup(state, _TABLE))
    require_shape(_TABLE, table, (None,))
    spaces = find_spaces(table.size, layers.input_width - 3, _HABITS, overrides.hash)
    why = [f"keys {prefix}*, {len(layers.weights)} layers", "bounds [-1, 1]: the sphere's cube, in which it trains"]
    warnings: list[str] = []
    mask = overrides.level_mask or _open_levels(checkpoint, table, spaces[0].written()[0].grid, why, warnings)
    entries = {
        **shared_entries(overrides, UNIT_CUBE),
        "grid_radius": overrides.hash.radius or _RADIUS,
        "level_mask": mask,
        "source": {"family": FAMILY},
    }
    readings = space_readings(table, spaces, layers.tensors(), entries)
    return converted_of(FAMILY, tuple(why), readings, tuple(warnings))


def _layers(state: dict[str, Any], source: TensorSource) -> Layers:
    """The hidden layers, then the one for the distance. The last of ``linears`` makes color's features alone."""
    names: Sequence[str] = [*layer_names(state, "mlp.linears.")[:-1], "mlp.linear_sdf"]
    layers = read_layers(state, names, source)
    require_extra_columns(layers, names)
    if len(names) > 4:
        raise FieldFormatError(f"a geometry network of {len(names)} layers", reason="FAMILY_NOT_SUPPORTED")
    return layers


def _open_levels(
    checkpoint: dict[Any, Any], table: Float32Array, grid: HashGridConfig, why: list[str], warnings: list[str]
) -> int | None:
    """How many levels coarse-to-fine training had opened by its last iteration."""
    iteration = step_of(checkpoint, "iteration")
    if iteration is None:
        warnings.append("LEVEL_MASK_ASSUMED: the checkpoint has no iteration; all levels are taken to be in use")
        return None
    by_step = (iteration - _WARM_UP) // _STEPS_A_LEVEL
    few, many = (min(max(first, by_step), grid.levels) for first in _FIRST_LEVELS)
    opened = few
    if few != many:
        opened = many if _is_trained(table, grid, many - 1) else few
        warnings.append(
            f"LEVEL_MASK_ASSUMED: coarse to fine from {_FIRST_LEVELS[0]} or {_FIRST_LEVELS[1]} levels on; by the table"
            f" {opened} are in use; say level_mask if not"
        )
    why.append(f"coarse to fine, iteration {iteration}: {opened} of {grid.levels} levels are in use")
    return opened


def _is_trained(table: Float32Array, grid: HashGridConfig, level: int) -> bool:
    entries = grid.level_entries()
    start = sum(entries[:level]) * grid.features_per_level
    features = table[start : start + entries[level] * grid.features_per_level]
    return bool(np.abs(features).max() > _UNTRAINED)
