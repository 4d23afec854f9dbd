"""Small random fields for the tests of this folder."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.schema.hash_grid_config import HashGridConfig

GRID = HashGridConfig.from_top_resolution(64, levels=4, log2_table_size=10, base_resolution=8)


def description(**changes: Any) -> dict[str, Any]:
    """A whole description, with some entries changed."""
    values: dict[str, Any] = {
        "kind": "neus_facto",
        "hash": asdict(GRID),
        "positional_encoding": {"degree": 6, "two_pi": False},
        "use_grid": True,
        "contraction": "none",
        "level_mask": None,
        "bounds": [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]],
        "label": None,
        "source": {},
    }
    return values | changes


def tensors(layers: int = 3, hidden: int = 16, grid: HashGridConfig = GRID) -> dict[str, NDArray[Any]]:
    """Random parameters of a field with that many linear layers; the last has four rows, as trainers save it."""
    rng = np.random.default_rng(7)
    width = 39 + grid.width
    made = {"hash_table": rng.normal(size=(grid.entries, grid.features_per_level)).astype(np.float32)}
    columns = width
    for i in range(layers):
        if i == 4:
            columns += width
        rows = 4 if i == layers - 1 else hidden
        made[f"layers.{i}.weight"] = (rng.normal(size=(rows, columns)) / np.sqrt(columns)).astype(np.float32)
        made[f"layers.{i}.bias"] = (0.1 * rng.normal(size=rows)).astype(np.float32)
        columns = rows
    return made
