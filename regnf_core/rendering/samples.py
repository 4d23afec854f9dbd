"""What was found along the rays of a tile."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class TileSamples:
    """Places where rays see something, for shading.

    ray: (M,) int64 · points: (M, 3) · normals: (M, 3) unit, 0 where the gradient vanishes · weight: (M,), of a ray's
    color; a ray's weights add up to its opacity · opacity: (N,) and length: (N,) along the ray, of each of N rays;
    length means nothing where the opacity is 0.
    """

    ray: Tensor
    points: Tensor
    normals: Tensor
    weight: Tensor
    opacity: Tensor
    length: Tensor
