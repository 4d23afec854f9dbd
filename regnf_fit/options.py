"""What all fits have in common: the size of the network, its training, and how progress is told."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from regnf_core.schema.hash_grid_config import HashGridConfig

FitProgress = Callable[[int, float, float], None]
"""Called from time to time with the iteration, its loss and an estimate of the seconds left. May raise to stop."""


def grid_of_levels(levels: int, nodes: int = 512, log2_table_size: int = 15) -> HashGridConfig:
    """Return a hash grid of so many levels, from 16 to ``nodes`` along an edge, with at most 2^log2_table_size entries
    a level."""
    return HashGridConfig.from_top_resolution(
        nodes, levels=levels, features_per_level=2, log2_table_size=log2_table_size, base_resolution=16
    )


@dataclass(frozen=True)
class NetworkOptions:
    """Size and training of the network of a field that is fitted."""

    grid: HashGridConfig = field(default_factory=lambda: grid_of_levels(10))
    """The hash grid over [-2, 2]^3: more entries and a finer top level keep thinner parts, in a larger file."""
    hidden_layers: int = 2
    hidden_width: int = 128
    iterations: int = 3000
    table_rate: float = 1e-2
    network_rate: float = 2e-3
    final_rate: float = 0.01
    """The share of the learning rates that is left at the end of their cosine decay."""
    half_table: bool = True
    """Store the hash table in half precision: half the file, and distances change by less than 1e-4."""

    def rate_share(self, iteration: int) -> float:
        """The share of the learning rates that is left at ``iteration``: a cosine from 1 down to ``final_rate``."""
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(iteration / self.iterations, 1.0)))
        return self.final_rate + (1.0 - self.final_rate) * cosine
