"""What the families with a hash grid share: from a table and layers to the readings of a ``neus_facto`` field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from regnf_core.importing.arrays import Float32Array
from regnf_core.importing.families.converted import Reading
from regnf_core.importing.families.grid_search import grid_name
from regnf_core.schema.hash_grid_config import HashGridConfig


def grid_readings(
    table: Float32Array, grids: Sequence[HashGridConfig], layers: dict[str, Float32Array], entries: dict[str, Any]
) -> tuple[Reading, ...]:
    """One reading a grid. table: all its numbers · layers: tensors by name · entries: the rest of the description."""
    return tuple(
        Reading(
            grid_name(grid),
            {"kind": "neus_facto", **entries, "hash": asdict(grid), "use_grid": True},
            {**layers, "hash_table": table.reshape(-1, grid.features_per_level)},
        )
        for grid in grids
    )


def step_of(checkpoint: dict[Any, Any], name: str) -> int | None:
    """The trainer's count of steps, or None where the checkpoint holds none."""
    value = checkpoint.get(name)
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else None
