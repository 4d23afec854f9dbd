"""Points of the scene's surface around the detection, for pictures and viewers."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.surface.projection import project_to_surface
from regnf_core.surface.upsampling import upsample

_SEED_SHARE = 0.2
_NEWTON_STEPS = 3
_TOLERANCE = 1e-3  # of the bounds' diagonal: largest |S| at a point that is kept


def sample_surroundings(
    scene: SdfField, detection: OrientedBox, count: int, generator: torch.Generator
) -> SurfaceSamples:
    """About ``count`` points of the scene's surface outside the detection box, scene frame, with unit normals.

    Random points of the bounds are projected onto the surface. Those that do not arrive are dropped, and the gaps
    between the others are filled. This is far cheaper than rays from many views.
    """
    low, high = scene.bounds

    def in_surroundings(points: Tensor) -> Tensor:
        within: Tensor = ((points >= low.to(points)) & (points <= high.to(points))).all(-1)
        return within & ~detection.contains(points)

    points = (low + (high - low) * torch.rand(int(_SEED_SHARE * count), 3, generator=generator)).to(scene.device)
    found = project_to_surface(scene.signed_distance_and_gradient, points, _NEWTON_STEPS)
    kept = (found.distance.abs() <= _TOLERANCE * float((high - low).norm())) & in_surroundings(found.points)
    normals = torch.nn.functional.normalize(found.gradient[kept], dim=-1)
    seeds = SurfaceSamples(found.points[kept], normals)
    return upsample(scene, seeds, count, generator, in_surroundings) if len(seeds.points) else seeds
