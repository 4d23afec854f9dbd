"""More surface points between those already found, for pictures and viewers. Cheaper than casting more rays."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.points import gaps
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.surface.projection import project_to_surface

_MAX_SHIFT = 1.5  # gaps between a new point and the old one that it starts from
_MAX_GAP = 4.0  # typical gaps; else an isolated stray point would receive most of the new points
_NEWTON_STEPS = 1  # new points start within a gap of the surface
_TOLERANCE_SHARE = 0.05  # of a typical gap: largest |S| at a new point


def upsample(
    field: SdfField,
    samples: SurfaceSamples,
    count: int,
    generator: torch.Generator,
    inside: Callable[[Tensor], Tensor],
) -> SurfaceSamples:
    """The samples and new ones, about ``count`` in all: old points shifted along the surface, then projected onto it.

    ``inside`` tells which new points (N, 3) are kept, (N,) bool. Same frame and unit as the samples.
    """
    missing = count - samples.points.shape[0]
    if missing <= 0:
        return samples
    local = gaps(samples.points).cpu()
    gap = float(local.median())
    local = local.clamp_max(_MAX_GAP * gap)
    # In proportion to the area around a point, so that sparsely sampled parts are filled first.
    seeds = torch.multinomial(local.square() + 1e-12, missing, replacement=True, generator=generator)
    shift = _MAX_SHIFT * local[seeds].unsqueeze(-1) * (2.0 * torch.rand(missing, 3, generator=generator) - 1.0)
    seeds, shift = seeds.to(samples.points.device), shift.to(samples.points)
    normals = samples.normals[seeds]
    points = samples.points[seeds] + shift - (shift * normals).sum(-1, keepdim=True) * normals
    found = project_to_surface(field.signed_distance_and_gradient, points, _NEWTON_STEPS)
    kept = (found.distance.abs() <= _TOLERANCE_SHARE * gap) & inside(found.points)
    unit = torch.nn.functional.normalize(found.gradient, dim=-1)
    return SurfaceSamples.cat([samples, SurfaceSamples(found.points[kept], unit[kept])])
