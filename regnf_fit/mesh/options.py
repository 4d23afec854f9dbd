"""Options of a fit, and what it reports."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from regnf_core.schema.hash_grid_config import HashGridConfig

FitProgress = Callable[[int, float, float], None]
"""Called now and then with the iteration, its loss and an estimate of the seconds left. May raise to stop the fit."""


def _default_grid() -> HashGridConfig:
    return HashGridConfig.from_top_resolution(
        512, levels=10, features_per_level=2, log2_table_size=15, base_resolution=16
    )


@dataclass(frozen=True)
class FitOptions:
    """How a field is fitted. Lengths are shares of the target's diagonal, so that they suit a cup and a room alike."""

    grid: HashGridConfig = field(default_factory=_default_grid)
    """The hash grid over [-2, 2]^3: more entries and a finer top level keep thinner parts, in a larger file."""
    hidden_layers: int = 2
    hidden_width: int = 128
    """neus-facto itself has 256; half of that halves the cost of a registration and loses little."""
    iterations: int = 3000
    batch: int = 6144
    """Points an iteration, for the distances."""
    gradient_batch: int = 2048
    """Points an iteration, near the surface, for distance and gradient."""
    gradient_weight: float = 0.02
    """Weight of the gradient's squared error against the distance's absolute error over the diagonal."""
    table_rate: float = 1e-2
    network_rate: float = 2e-3
    final_rate: float = 0.01
    """The learning rates' share that is left at the end of their cosine decay."""
    near_points: int = 600_000
    """Points near the surface in the pool of exact distances."""
    volume_points: int = 200_000
    """Points anywhere in the padded bounds in the pool."""
    noise: tuple[float, ...] = (0.002, 0.01, 0.04)
    """Standard deviations of the near points' distance from the surface; an equal share of the points for each."""
    padding: float = 0.25
    """How far beyond the target's bounds the field is fitted."""
    margin: float = 0.05
    """How far beyond the target's bounds the written field's own bounds lie."""
    half_table: bool = True
    """Store the hash table in half precision: half the file, and distances change by less than 1e-4."""

    def rate_share(self, iteration: int) -> float:
        """What is left of the learning rates at ``iteration``: a cosine from 1 down to ``final_rate``."""
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(iteration / self.iterations, 1.0)))
        return self.final_rate + (1.0 - self.final_rate) * cosine


@dataclass(frozen=True)
class FitReport:
    """How well a field agrees with the exact one, on fresh points near the surface; errors in diagonals."""

    mean_error: float
    p95_error: float
    max_error: float
    volume_mean_error: float
    """The same anywhere in the padded bounds."""
    mean_gradient_norm: float
    mean_normal_cosine: float
    """Mean cosine between the field's gradient and the exact one. Both means are over points in free space: a mesh of
    overlapping parts has creases inside that no field should reproduce."""
    diagonal: float
    """The target's diagonal, own units: what the errors are shares of."""
    iterations: int
    seconds: float
