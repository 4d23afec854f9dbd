"""Small random fields for the tests of this folder."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from regnf_core.fields.neus_facto import build_neus_facto
from regnf_core.fields.neus_facto_function import NeusFactoFunction
from regnf_core.schema.description import FieldDescription
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.safe_format import parse_description

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


def function(layers: int = 3, grid: HashGridConfig = GRID, **changes: Any) -> NeusFactoFunction:
    described: FieldDescription = parse_description(description(hash=asdict(grid), **changes))
    made = {name: torch.from_numpy(value) for name, value in tensors(layers, grid=grid).items()}
    return build_neus_facto(described, made).function  # type: ignore[arg-type]


def places(reach: float = 1.0, count: int = 300) -> torch.Tensor:
    """Points spread over a cube, and its corners."""
    spread = 2.0 * torch.rand(count, 3, generator=torch.Generator().manual_seed(5)) - 1.0
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    return reach * torch.cat([spread, corners])
