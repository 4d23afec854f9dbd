"""The pool of exact distances that a field is fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.fields.base import SdfField
from regnf_core.fields.composite import SurfaceSource
from regnf_core.fields.transformed import TransformedField

_PROJECTION_STEPS = 3


@dataclass(frozen=True)
class ExactSamples:
    """Points (N, 3) with their exact signed distances (N,) and gradients (N, 3), target frame."""

    points: Tensor
    distances: Tensor
    gradients: Tensor

    def __len__(self) -> int:
        return self.points.shape[0]

    def take(self, index: Tensor) -> ExactSamples:
        """The samples at ``index`` (M,)."""
        return ExactSamples(self.points[index], self.distances[index], self.gradients[index])


def diagonal(target: SdfField) -> float:
    """Length of the space diagonal of the target's bounds, own units."""
    lower, upper = target.bounds
    return float((upper - lower).norm())


def padded_bounds(target: SdfField, padding: float) -> Tensor:
    """(2, 3) float64: the target's bounds grown on every side by ``padding`` diagonals."""
    grow = padding * diagonal(target)
    return target.bounds + torch.tensor([[-grow], [grow]], dtype=torch.float64)


def near_samples(target: SdfField, count: int, noise: tuple[float, ...], rng: np.random.Generator) -> ExactSamples:
    """About ``count`` samples round the surface: surface points with Gaussian noise of several scales, as diagonals."""
    surface = _surface_points(target, count, rng)
    scales = diagonal(target) * rng.choice(noise, size=(len(surface), 1))
    return _measure(target, surface + scales * rng.standard_normal(surface.shape))


def volume_samples(target: SdfField, count: int, padding: float, rng: np.random.Generator) -> ExactSamples:
    """``count`` samples uniform in the padded bounds."""
    lower, upper = padded_bounds(target, padding).numpy()
    return _measure(target, rng.uniform(lower, upper, size=(count, 3)))


def _measure(target: SdfField, points: NDArray[np.float64]) -> ExactSamples:
    queries = torch.from_numpy(points.astype(np.float32))
    distances, gradients = target.signed_distance_and_gradient(queries)
    return ExactSamples(queries, distances.cpu(), gradients.cpu())


def _surface_points(target: SdfField, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Surface points (M, 3): the target's own, or else points of its bounds carried down its gradient."""
    if isinstance(target, TransformedField) and isinstance(target.field, SurfaceSource):
        points = torch.from_numpy(_surface_points(target.field, count, rng))
        moved: NDArray[np.float64] = target.T_field_frame.inverse().apply(points).numpy()
        return moved
    if isinstance(target, SurfaceSource):
        if not target.area > 0.0:
            raise InvalidInputError("the target's surface has no area", reason="NO_SURFACE_IN_TARGET")
        return target.sample_surface(count, rng)
    points = volume_samples(target, count, 0.05, rng).points
    for _ in range(_PROJECTION_STEPS):
        distance, gradient = target.signed_distance_and_gradient(points)
        points = points - distance[:, None] * gradient
    arrived = target.signed_distance(points).abs() < 1e-3 * diagonal(target)
    if not arrived.any():
        raise InvalidInputError("the target has no surface within its bounds", reason="NO_SURFACE_IN_TARGET")
    surface: NDArray[np.float64] = points[arrived].double().numpy()
    return surface
