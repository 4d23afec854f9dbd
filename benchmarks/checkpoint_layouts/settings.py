"""Random settings of the trainers whose fields are hash grids."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from typing import Any

from regnf_core.schema.hash_grid_config import HashGridConfig

FAMILIES = ("sdfstudio", "nerfstudio", "instant_nsr_pl", "neuralangelo")
_MAX_NUMBERS = 6_000_000


@dataclass(frozen=True)
class Settings:
    """What a trainer's configuration says, as far as it decides the function."""

    family: str
    grid: HashGridConfig
    written: dict[str, Any]
    """Entries of the upload's description that say the same."""
    hidden: int
    hidden_layers: int
    degree: int
    """Of the sines: 0 where the network has no columns for them."""
    uses_sines: bool
    two_pi: bool
    uses_grid: bool
    radius: float
    """Half of the scene's cube."""
    grid_radius: float
    open_levels: int
    steps: int

    @property
    def input_width(self) -> int:
        """Columns of the first layer."""
        return 3 + 6 * self.degree + self.grid.width

    @property
    def outputs(self) -> int:
        """Rows of the last layer."""
        return 1 if self.family == "neuralangelo" else 5


def random_settings(family: str, rng: random.Random, steps: int = 80) -> Settings:
    """Settings as somebody may have written them; one in six fields is untrained."""
    while True:
        settings = _draw(family, rng, steps)
        if settings is not None:
            return settings


def _draw(family: str, rng: random.Random, steps: int) -> Settings | None:
    grid, said = _grid(family, rng)
    if grid is None or grid.entries * grid.features_per_level > _MAX_NUMBERS or grid.width > 160:
        return None
    studio = family in ("sdfstudio", "nerfstudio")
    deep = family == "sdfstudio" and rng.random() < 0.2
    hidden = rng.choice((64, 128))
    degree = rng.choice((6, 6, 6, 4, 8, 10)) if studio else 0
    open_levels = grid.levels
    if family in ("instant_nsr_pl", "neuralangelo") and rng.random() < 0.4:
        open_levels = rng.randint(min(4, grid.levels), grid.levels)
    trained = rng.random() > 1 / 6
    if deep and hidden <= 3 + 6 * degree + grid.width:
        return None
    radius = rng.choice((1.0, 1.5)) if family == "instant_nsr_pl" else 1.0
    return Settings(
        family=family,
        grid=grid,
        written={"hash": said} | ({"positional_encoding": {"degree": degree}} if studio else {}),
        hidden=hidden,
        hidden_layers=8 if deep else rng.choice((1, 2)),
        degree=degree,
        uses_sines=studio and rng.random() < 0.8,
        two_pi=family == "nerfstudio",
        uses_grid=not (deep and rng.random() < 0.5),
        radius=radius,
        grid_radius=2.0 if family in ("sdfstudio", "nerfstudio", "neuralangelo") else radius,
        open_levels=open_levels,
        steps=steps if trained else 0,
    )


def _grid(family: str, rng: random.Random) -> tuple[HashGridConfig | None, dict[str, Any]]:
    levels = rng.randint(4, 20)
    base = rng.choice((16, 16, 32, 8, 64, rng.randint(4, 64)))
    top = rng.choice((256, 512, 1024, 2048, 2048, 4096, rng.randint(64, 4096)))
    if family == "neuralangelo":
        base, top = 2 ** rng.randint(3, 6), 2 ** rng.randint(8, 12)
    growth = round(rng.uniform(1.2, 2.0), rng.choice((2, 3, 4)))
    by_growth = family == "instant_nsr_pl" and rng.random() < 0.6
    features, log2_size = rng.choice((1, 2, 2, 4, 8)), rng.randint(10, 19)
    said: dict[str, Any] = {
        "levels": levels,
        "features_per_level": features,
        "log2_table_size": log2_size,
        "base_resolution": base,
        "interpolation": rng.choice(("linear", "smoothstep")),
    }
    if by_growth:
        said["per_level_scale"] = growth
    else:
        if top <= base or (top / base) ** (1.0 / (levels - 1)) > 8:
            return None, {}
        said["top_resolution"] = top
        growth = math.exp(math.log(top / base) / (levels - 1))
    if base * growth ** (levels - 1) > 20_000:
        return None, {}
    grid = HashGridConfig(levels, features, log2_size, base, growth, interpolation=said["interpolation"])
    return grid, said
