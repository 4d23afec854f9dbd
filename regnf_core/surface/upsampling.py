"""More surface points between those already found, for pictures and viewers: cheaper than casting more rays."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.points import gaps
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.surface.projection import project_to_surface

_REACH = 1.5  # new points lie up to this many gaps from an old one
_LARGEST_GAP = 4.0  # typical gaps; a lone stray point must not draw all new ones
_NEWTON_STEPS = 1  # new points start within a gap of the surface
_TOLERANCE_SHARE = 0.05  # of a typical gap: largest |S| at a new point


def upsample(
    field: SdfField,
    samples: SurfaceSamples,
    count: int,
    generator: torch.Generator,
    inside: Callable[[Tensor], Tensor],
) -> SurfaceSamples:
    """The samples and about as many new ones as make ``count``: shaken within the surface, then drawn back onto it.

    ``inside`` says of points (N, 3) which may stay, (N,) bool. Same frame and unit as the samples.
    """
    missing = count - samples.points.shape[0]
    if missing <= 0:
        return samples
    local = gaps(samples.points).cpu()
    gap = float(local.median())
    local = local.clamp_max(_LARGEST_GAP * gap)
    # By the area that a point stands for, so that sparsely seen parts are filled first.
    seeds = torch.multinomial(local.square() + 1e-12, missing, replacement=True, generator=generator)
    shake = _REACH * local[seeds].unsqueeze(-1) * (2.0 * torch.rand(missing, 3, generator=generator) - 1.0)
    seeds, shake = seeds.to(samples.points.device), shake.to(samples.points)
    normals = samples.normals[seeds]
    points = samples.points[seeds] + shake - (shake * normals).sum(-1, keepdim=True) * normals
    found = project_to_surface(field.signed_distance_and_gradient, points, _NEWTON_STEPS)
    kept = (found.distance.abs() <= _TOLERANCE_SHARE * gap) & inside(found.points)
    unit = torch.nn.functional.normalize(found.gradient, dim=-1)
    return SurfaceSamples.cat([samples, SurfaceSamples(found.points[kept], unit[kept])])
