"""The scene's surface round the detection, for pictures and viewers: where in the room does the object stand?"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.result import SurfaceSamples
from regnf_core.surface.densify import densify

_SEED_SHARE = 0.2
_NEWTON_STEPS = 3
_MIN_SLOPE = 0.25  # squared gradient below which a Newton step is not trusted to its full length
_TOLERANCE = 1e-3  # of the bounds' diagonal: largest |S| at a point that is kept


def surroundings(scene: SdfField, detection: OrientedBox, count: int, generator: torch.Generator) -> SurfaceSamples:
    """About ``count`` points of the scene's surface outside the detection box, scene frame, with unit normals.

    Random points of the bounds are drawn onto the surface by Newton's method along the gradient; those that do not
    arrive are dropped, and the gaps between the others filled. Far cheaper than rays from many views.
    """
    low, high = (corner.float() for corner in scene.bounds)

    def shown(points: Tensor) -> Tensor:
        within: Tensor = ((points >= low.to(points)) & (points <= high.to(points))).all(-1)
        return within & ~detection.contains(points)

    points = (low + (high - low) * torch.rand(int(_SEED_SHARE * count), 3, generator=generator)).to(scene.device)
    for _ in range(_NEWTON_STEPS):
        distance, gradient = scene.signed_distance_and_gradient(points)
        points = points - _newton_step(distance, gradient.to(points))
    distance, gradient = scene.signed_distance_and_gradient(points)
    kept = (distance.to(points).abs() <= _TOLERANCE * float((high - low).norm())) & shown(points)
    normals = torch.nn.functional.normalize(gradient.to(points)[kept], dim=-1)
    seeds = SurfaceSamples(points[kept], normals)
    return densify(scene, seeds, count, generator, shown) if len(seeds.points) else seeds


def _newton_step(distance: Tensor, gradient: Tensor) -> Tensor:
    length = distance.to(gradient) / gradient.square().sum(-1).clamp_min(_MIN_SLOPE)
    return length.unsqueeze(-1) * gradient
