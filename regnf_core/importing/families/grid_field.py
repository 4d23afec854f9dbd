"""What the families with a hash grid share: from a table and layers to the readings of a ``neus_facto`` field."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

from regnf_core.importing.arrays import Float32Array
from regnf_core.importing.families.converted import Reading
from regnf_core.importing.families.grid_search import grid_name
from regnf_core.importing.families.grid_space import GridSpace
from regnf_core.schema.hash_grid_config import HashGridConfig

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
            said = replace(reading, say={"hash": entry.said}, tier=tier, scale=finest_of(entry.grid))
            readings.append(replace(said, interpolation=interpolation))
    return most_usual(readings)


def finest_of(grid: HashGridConfig) -> float:
    """Natural logarithm of the finest level's resolution."""
    return math.log(grid.scales()[-1] + 1.0)


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
