"""Exact fields of boxes, and of several fields taken together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.fields.composite import SurfaceSource
from regnf_core.fields.observation import ColorFunction, SdfField, has_color, inverse_deviation_of


@dataclass(frozen=True)
class BoxField:
    """The exact field of a solid axis-aligned box, on the CPU. lower, upper: (3,), own frame."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU: the box itself."""
        return torch.tensor([self.lower, self.upper], dtype=torch.float64)

    @property
    def device(self) -> torch.device:
        return torch.device("cpu")

    def to(self, device: torch.device | str) -> BoxField:
        del device
        return self

    def signed_distance(self, points: Tensor) -> Tensor:
        return self.signed_distance_and_gradient(points)[0]

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        lower, upper = self.bounds
        offset = points.cpu().double() - (lower + upper) / 2.0
        beyond = offset.abs() - (upper - lower) / 2.0  # (N, 3)
        outward = beyond.clamp_min(0.0)
        outside = outward.norm(dim=-1)
        deepest, axis = beyond.max(dim=-1)
        is_outside = deepest > 0.0
        distance = torch.where(is_outside, outside, deepest)
        nearest_face = torch.nn.functional.one_hot(axis, 3).double()
        away = torch.where(is_outside[:, None], outward / outside.clamp_min(1e-300)[:, None], nearest_face)
        return distance.float(), (away * torch.where(offset < 0.0, -1.0, 1.0)).float()

    @property
    def area(self) -> float:
        """Area of the six faces."""
        return float(self._face_areas().sum() * 2.0)

    def sample_surface(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """``count`` points (count, 3), uniform over the faces."""
        lower, upper = self.bounds.numpy()
        areas = self._face_areas()
        axis = rng.choice(3, size=count, p=areas / areas.sum())
        unit = rng.random((count, 3))
        unit[np.arange(count), axis] = rng.integers(0, 2, size=count)
        points: NDArray[np.float64] = lower + unit * (upper - lower)
        return points

    def _face_areas(self) -> NDArray[np.float64]:
        """(3,): area of one of the two faces across each axis."""
        x, y, z = self.bounds.diff(dim=0).squeeze(0).tolist()
        return np.array([y * z, z * x, x * y])


class UnionField:
    """Several solids taken together: the smallest of their distances, exact wherever no two of them overlap.

    weights: share of the surface samples that each part gets; None shares by area.
    """

    color: ColorFunction
    """That of the nearest part, where all parts have color."""

    def __init__(self, parts: Sequence[SdfField], weights: Sequence[float] | None = None) -> None:
        self.parts = list(parts)
        self.weights = None if weights is None else np.asarray(weights, dtype=np.float64)
        if all(has_color(part) for part in parts):
            self.color = self._color

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU: the box round all parts."""
        boxes = torch.stack([part.bounds for part in self.parts])
        return torch.stack((boxes[:, 0].amin(dim=0), boxes[:, 1].amax(dim=0)))

    @property
    def device(self) -> torch.device:
        """The first part's device."""
        return self.parts[0].device

    @property
    def inverse_deviation(self) -> float | None:
        """The smallest of the parts': the sharpness that all have; None where one has none."""
        known = [inverse for part in self.parts if (inverse := inverse_deviation_of(part)) is not None]
        return min(known) if len(known) == len(self.parts) else None

    def to(self, device: torch.device | str) -> UnionField:
        """The union of the parts on another device."""
        return UnionField(
            [part.to(device) for part in self.parts], None if self.weights is None else self.weights.tolist()
        )

    def signed_distance(self, points: Tensor) -> Tensor:
        return self.signed_distance_and_gradient(points)[0]

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3), that of the nearest part.

        A part is asked only where its bounding box is nearer than what has been found.
        """
        distance, gradient, _ = self._nearest(points)
        return distance, gradient

    def _color(self, points: Tensor, directions: Tensor) -> Tensor:
        points = points.to(device=self.device, dtype=torch.float32)
        directions = directions.to(points)
        nearest = self._nearest(points)[2]
        color = torch.zeros_like(points)
        for number, part in enumerate(self.parts):
            here = nearest == number
            assert has_color(part)
            color[here] = part.color(points[here], directions[here])
        return color

    def _nearest(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Distance (N,), gradient (N, 3) and number (N,) of the nearest part."""
        points = points.to(device=self.device, dtype=torch.float32)
        distance = points.new_full((points.shape[0],), torch.inf)
        gradient = torch.zeros_like(points)
        nearest = torch.zeros(points.shape[0], dtype=torch.int64, device=points.device)
        for number, part in enumerate(self.parts):
            lower, upper = part.bounds.to(points)
            beyond = torch.maximum(lower - points, points - upper).clamp_min(0.0).norm(dim=-1)
            asked = torch.nonzero(beyond <= distance.clamp_min(0.0)).squeeze(-1)
            here, slope = part.signed_distance_and_gradient(points[asked])
            nearer = here < distance[asked]
            distance[asked[nearer]] = here[nearer]
            gradient[asked[nearer]] = slope[nearer]
            nearest[asked[nearer]] = number
        return distance, gradient, nearest

    @property
    def area(self) -> float:
        """Sum of the parts' areas."""
        return sum(part.area for part in self._sources())

    def sample_surface(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """``count`` points (count, 3), shared among the parts by weight, in random order."""
        sources = self._sources()
        weights = np.array([part.area for part in sources]) if self.weights is None else self.weights
        counts = rng.multinomial(count, weights / weights.sum())
        drawn = [part.sample_surface(int(n), rng) for part, n in zip(sources, counts, strict=True)]
        return rng.permutation(np.concatenate(drawn))

    def _sources(self) -> list[SurfaceSource]:
        return [part for part in self.parts if isinstance(part, SurfaceSource)]
