"""Options of a fit to a mesh, and what it reports."""

from __future__ import annotations

from dataclasses import dataclass

from regnf_fit.options import NetworkOptions


@dataclass(frozen=True)
class FitOptions(NetworkOptions):
    """How a field is fitted. Lengths are shares of the target's diagonal, so that they suit a cup and a room alike."""

    hidden_width: int = 128
    """neus-facto itself has 256; half of that halves the cost of a registration and loses little."""
    batch: int = 6144
    """Points an iteration, for the distances."""
    gradient_batch: int = 2048
    """Points an iteration, near the surface, for distance and gradient."""
    gradient_weight: float = 0.02
    """Weight of the gradient's squared error against the distance's absolute error over the diagonal."""
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
