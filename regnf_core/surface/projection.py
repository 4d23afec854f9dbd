"""Points moved onto a field's zero level by Newton's method along the gradient.

A step subtracts S g / |g|^2, with S the signed distance and g its gradient at the point. Where the gradient is short,
the step is long and wrong. So |g| counts as ``min_slope`` at least. Four values are in use:

    0.5     MIN_SLOPE: clouds for viewers, an object's bounds
    0.2     samples for registration (robust/constants/); shorter gradients are dropped there
    0.001   the surface beneath a sample (robust/constants/): only a gradient of zero is left out
    1e-6    the import gate, which bounds the steps' length as well
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

MIN_SLOPE = 0.5
"""Least |g| that is trusted. The gradient of an exact distance has length 1."""

DistanceAndGradient = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Signed distance (N,) and gradient (N, 3) at points (N, 3), for instance ``field.signed_distance_and_gradient``."""


@dataclass(frozen=True, eq=False)
class ProjectedPoints:
    """Where the steps end: points (N, 3), and the field's distance (N,) and gradient (N, 3) there, in one dtype."""

    points: Tensor
    distance: Tensor
    gradient: Tensor


def newton_step(distance: Tensor, gradient: Tensor, min_slope: float = MIN_SLOPE) -> Tensor:
    """(N, 3), what to subtract from points with this distance (N,) and gradient (N, 3) to come to the zero level."""
    length = distance / gradient.square().sum(-1).clamp_min(min_slope**2)
    return length.unsqueeze(-1) * gradient


def project_to_surface(
    evaluate: DistanceAndGradient, points: Tensor, steps: int, min_slope: float = MIN_SLOPE
) -> ProjectedPoints:
    """The points (N, 3) after ``steps`` Newton steps. Evaluates the field ``steps`` + 1 times at each point.

    Nothing is dropped: the caller decides by ``distance`` which points have arrived.
    """
    for _ in range(steps):
        distance, gradient = evaluate(points)
        points = points - newton_step(distance.to(points), gradient.to(points), min_slope)
    distance, gradient = evaluate(points)
    return ProjectedPoints(points, distance.to(points), gradient.to(points))
