"""Which hash grids a bare table of parameters may belong to: every one that its size and the width allow."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array
from regnf_core.importing.families.converted import Reading
from regnf_core.importing.families.grid_space import MAX_BASE, GridInterval, GridSpace, solve
from regnf_core.importing.families.layers import contradiction
from regnf_core.importing.upload_description import GridDescription
from regnf_core.schema.hash_grid_config import MAX_GROWTH, HashGridConfig, Interpolation

_MAX_LEVELS = 32
_FEATURES = (2, 4, 8, 1)
"""All that tiny-cuda-nn takes."""
_LOG2_SIZES = range(3, 25)
_BASES = range(2, MAX_BASE + 1)


@dataclass(frozen=True)
class GridHabits:
    """What holds for all of a family's configurations. features_per_level: the usual ones, the most usual first."""

    features_per_level: tuple[int, ...]
    interpolation: Interpolation
    writes_growth: bool = False
    """Whether configurations give the growth itself, and not the finest resolution."""


def find_spaces(parameters: int, width: int, habits: GridHabits, given: GridDescription) -> tuple[GridSpace, ...]:
    """The grids with ``parameters`` numbers whose encoding is ``width`` wide, the most usual features first.

    What ``given`` says is taken as it is. Raises FieldFormatError: SETTINGS_CONTRADICT_TENSORS where nothing of what it
    says fits the tensors, HASH_GRID_NOT_RECOGNIZED where no grid at all does.
    """
    _require_width(width, given)
    spaces = tuple(_spaces(parameters, width, habits, given))
    if spaces:
        return spaces
    said = {name: value for name, value in vars(given).items() if value is not None and name != "interpolation"}
    if said:
        raise contradiction("hash", said, f"{parameters} numbers and {width} columns")
    message = f"no hash grid with {parameters} parameters and {width} features exists"
    raise FieldFormatError(message, reason="HASH_GRID_NOT_RECOGNIZED")


def grid_name(config: HashGridConfig) -> str:
    """A few words that tell one layout from another."""
    resolutions = config.level_resolutions()
    top = round(config.scales()[-1]) + 1
    name = f"{config.levels} levels of {config.features_per_level}, {resolutions[0]} to {top} nodes"
    strides = config.level_strides()
    moved = [f"level {i} by {strides[i]}" for i, nodes in enumerate(resolutions) if strides[i] != nodes]
    return f"{name}, indexed {' and '.join(moved)}" if moved else name


def _require_width(width: int, given: GridDescription) -> None:
    levels, features = given.levels, given.features_per_level
    if levels is not None and features is not None and levels * features != width:
        raise contradiction("hash.levels x hash.features_per_level", levels * features, f"{width} columns")


def _spaces(parameters: int, width: int, habits: GridHabits, given: GridDescription) -> Iterator[GridSpace]:
    for features in _features(habits, given):
        levels, rest = divmod(width, features)
        if rest or parameters % features or not 1 <= levels <= _MAX_LEVELS or given.levels not in (None, levels):
            continue
        intervals = _intervals(parameters // features, levels, given)
        if intervals:
            space = GridSpace(
                intervals,
                features,
                given.interpolation or habits.interpolation,
                habits.writes_growth,
                given.top_resolution,
                given.per_level_scale,
            )
            if space.written:
                yield space


def _features(habits: GridHabits, given: GridDescription) -> Sequence[int]:
    if given.features_per_level is not None:
        return (given.features_per_level,)
    return tuple(dict.fromkeys((*habits.features_per_level, *_FEATURES)))


def _intervals(entries: int, levels: int, given: GridDescription) -> tuple[GridInterval, ...]:
    sizes = _LOG2_SIZES if given.log2_table_size is None else (given.log2_table_size,)
    bases = _BASES if given.base_resolution is None else (given.base_resolution,)
    if given.per_level_scale is not None:
        return solve(entries, levels, sizes, bases, (given.per_level_scale,) * len(bases))
    if given.top_resolution is not None:
        steps = max(levels - 1, 1)
        fitting = [b for b in bases if b <= given.top_resolution <= b * MAX_GROWTH**steps]
        return solve(entries, levels, sizes, fitting, [(given.top_resolution / b) ** (1.0 / steps) for b in fitting])
    return solve(entries, levels, sizes, bases)


# What the families with a hash grid share: from a table and layers to the readings of a ``neus_facto`` field.

_MAX_STRIDES = 3
MAX_LAYOUTS = 512
"""Most layouts that are listed."""


def space_readings(
    table: Float32Array,
    spaces: Sequence[GridSpace],
    layers: dict[str, Float32Array],
    entries: dict[str, Any],
    interpolation: Literal["known", "open"] = "known",
) -> tuple[Reading, ...]:
    """One reading a layout of ``spaces``, the most usual first.

    table: all its numbers · layers: tensors by name · entries: the rest of the safe file's description · interpolation:
    whether it is known.
    """
    readings = []
    written = sorted((entry for space in spaces for entry in space.written), key=lambda entry: entry.order)
    for entry in written[:MAX_LAYOUTS]:
        # the training device may have indexed the same table otherwise
        others = tuple(itertools.islice(entry.grid.stride_variants(), _MAX_STRIDES)) if entry.tier == 0 else ()
        for reading in grid_readings(table, (entry.grid, *others), layers, entries):
            tier = entry.tier + (reading.description["hash"]["strides"] is not None)
            said = replace(reading, say={"hash": entry.said}, tier=tier, scale=math.log(entry.grid.scales()[-1] + 1.0))
            readings.append(replace(said, interpolation=interpolation))
    return most_usual(readings)


def most_usual(readings: Sequence[Reading]) -> tuple[Reading, ...]:
    """The MAX_LAYOUTS most usual ones, in order."""
    return tuple(sorted(readings, key=lambda reading: reading.tier)[:MAX_LAYOUTS])


def grid_readings(
    table: Float32Array, grids: Sequence[HashGridConfig], layers: dict[str, Float32Array], entries: dict[str, Any]
) -> tuple[Reading, ...]:
    """One reading a grid. table: all its numbers · layers: tensors by name · entries: the rest of the description."""
    kind = {"kind": "neus_facto", "use_grid": True} if entries.get("kind") is None else {}
    return tuple(
        Reading(
            grid_name(grid),
            {**kind, **entries, "hash": grid.described()},
            {**layers, "hash_table": table.reshape(-1, grid.features_per_level)},
        )
        for grid in grids
    )


def step_of(checkpoint: dict[Any, Any], name: str) -> int | None:
    """The trainer's count of steps, or None where the checkpoint holds none."""
    value = checkpoint.get(name)
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else None
