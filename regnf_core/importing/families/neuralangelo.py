"""Neuralangelo (Li et al. 2023): a hash grid over [-2, 2]^3 and a small network, opened from coarse to fine.

How many levels are open is not saved, but the number of iterations is. Where the formula leaves it open, the table
tells: the features of a level that never opened keep the small random values they began with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, require_shape
from regnf_core.importing.families.color.head import without_color
from regnf_core.importing.families.converted import ConvertedField, Reading, converted_of
from regnf_core.importing.families.grid_search import GridHabits, find_spaces, most_usual, space_readings, step_of
from regnf_core.importing.families.grid_space import GridSpace
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    Layers,
    layer_names,
    read_layers,
    refuse_other_entries,
    require_extra_columns,
    require_family,
    shared_entries,
    strip_prefix,
)
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import GridDescription, UploadDescription
from regnf_core.schema.hash_grid_config import HashGridConfig

FAMILY = "neuralangelo"
_PREFIX = "neural_sdf."
_COLOR = "neural_rgb"
_TABLE = "tcnn_encoding.params"
_HABITS = GridHabits((8, 4, 2, 1), "linear")
_WARM_UP, _STEPS_A_LEVEL = 5000, 5000
_FIRST_LEVELS = (4, 8)
"""Levels open from the start: the usual number, and that of the large scenes' configuration."""
_UNTRAINED = 1.01e-4
"""tiny-cuda-nn begins with features between -1e-4 and 1e-4."""
_RADIUS = 2.0
"""Half an edge of the cube that the grid covers, in all published configurations."""
_OTHER_RADII = (1.0, 1.5)
"""The sphere's own cube, and half as much beyond it: tried, because nothing else tells another ``range``."""


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, TENSOR_MISSING, TENSOR_SHAPE, HASH_GRID_NOT_RECOGNIZED and what
    TensorSource raises.
    """
    model = checkpoint.get("model")
    state = strip_prefix(model, _PREFIX)
    if not state:
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("level_mask", "hash"))
    layers = _layers(state, source)
    table = source.array(_TABLE, lookup(state, _TABLE))
    require_shape(_TABLE, table, (None,))
    spaces = find_spaces(table.size, layers.input_width - 3, _HABITS, overrides.hash)
    why = [f"keys {_PREFIX}*, {len(layers.weights)} layers", "bounds [-1, 1]: the sphere's cube, in which it trains"]
    warnings: list[str] = []
    masks = _open_levels(checkpoint, table, spaces, why, warnings) if overrides.level_mask is None else {}
    readings: list[Reading] = []
    for space in spaces:
        entries = {
            **shared_entries(overrides, UNIT_CUBE),
            "grid_radius": overrides.hash.radius or _RADIUS,
            "level_mask": overrides.level_mask or masks.get(_grid(space).levels),
            "source": {"family": FAMILY},
        }
        readings += space_readings(table, [space], layers.tensors(), entries)
    if overrides.hash == GridDescription():
        others = [_within(radius, one) for radius in _OTHER_RADII for one in readings if one.tier == 0]
        readings = [*others, *readings]
    converted = converted_of(FAMILY, tuple(why), most_usual(readings), tuple(warnings))
    colors = strip_prefix(model, f"{_COLOR}.")
    return converted if overrides.color.keep is False else without_color(converted, [_COLOR] if colors else [], FAMILY)


def _layers(state: dict[str, Any], source: TensorSource) -> Layers:
    """The hidden layers, then the one for the distance. The last of ``linears`` makes color's features alone."""
    names: Sequence[str] = [*layer_names(state, "mlp.linears.")[:-1], "mlp.linear_sdf"]
    layers = read_layers(state, names, source)
    require_extra_columns(layers, names)
    if len(names) > 4:
        raise FieldFormatError(
            f"a geometry network with {len(names)} layers is not supported", reason="FAMILY_NOT_SUPPORTED"
        )
    return layers


def _grid(space: GridSpace) -> HashGridConfig:
    return space.written[0].grid


def _within(radius: float, reading: Reading) -> Reading:
    """``reading`` with a grid over another cube."""
    say = {**reading.say, "hash": {**reading.say["hash"], "radius": radius}}
    name = f"{reading.name}, within {radius:g}"
    described = {**reading.description, "grid_radius": radius}
    return replace(reading, name=name, say=say, description=described, tier=reading.tier + 1)


def _open_levels(
    checkpoint: dict[Any, Any], table: Float32Array, spaces: Sequence[GridSpace], why: list[str], warnings: list[str]
) -> dict[int, int]:
    """How many levels coarse-to-fine training had opened by its last iteration, by the number of levels there are."""
    iteration = step_of(checkpoint, "iteration")
    if iteration is None:
        warnings.append("LEVEL_MASK_ASSUMED: the checkpoint has no iteration; all levels are assumed to be in use")
        return {}
    by_step = (iteration - _WARM_UP) // _STEPS_A_LEVEL
    opened, is_open = {}, False
    for grid in map(_grid, spaces):
        few, many = (min(max(first, by_step), grid.levels) for first in _FIRST_LEVELS)
        opened[grid.levels] = many if few != many and _is_trained(table, grid, many - 1) else few
        is_open = is_open or few != many
    if is_open:
        by_table = " or ".join(map(str, dict.fromkeys(opened.values())))
        warnings.append(
            f"LEVEL_MASK_ASSUMED: coarse to fine from {_FIRST_LEVELS[0]} or {_FIRST_LEVELS[1]} levels on; by the "
            f"table, {by_table} are in use; if not, give the import option level_mask"
        )
    told = " or ".join(f"{number} of {levels}" for levels, number in opened.items())
    why.append(f"coarse to fine, iteration {iteration}: {told} levels are in use")
    return opened


def _is_trained(table: Float32Array, grid: HashGridConfig, level: int) -> bool:
    entries = grid.level_entries()
    start = sum(entries[:level]) * grid.features_per_level
    features = table[start : start + entries[level] * grid.features_per_level]
    return bool(np.abs(features).max() > _UNTRAINED)
