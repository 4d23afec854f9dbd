"""Surface rendering: a ray sees the point where it first meets the zero level, and that is opaque."""

from __future__ import annotations

import torch

from regnf_core.rendering.samples import TileSamples
from regnf_core.rendering.tracing import Region, Start, trace
from regnf_core.surface.cameras import Rays

_LONGEST_CORRECTION = 5.0
"""Of a hit along its ray by the gradient, in tolerances."""
_FLATTEST = 0.05
"""Least cosine between ray and surface at which the gradient is used for that."""


def surface_samples(region: Region, rays: Rays, start: Start) -> TileSamples:
    """One sample a ray that meets a surface, with its normal; a last Newton step along the ray makes it exact."""
    length = trace(region, rays, start)
    ray = torch.isfinite(length).nonzero().squeeze(-1)
    points = rays.origins[ray] + length[ray, None] * rays.directions[ray]
    distance, gradient = (value.to(points) for value in region.field.signed_distance_and_gradient(points))
    slope = (gradient * rays.directions[ray]).sum(-1)
    correction = torch.where(slope < -_FLATTEST, -distance / slope.clamp_max(-_FLATTEST), 0.0)
    most = _LONGEST_CORRECTION * region.tolerance
    correction = correction.clamp(-most, most)
    points = points + correction[:, None] * rays.directions[ray]
    length = torch.where(torch.isfinite(length), length, 0.0)
    length[ray] += correction
    opacity = torch.zeros_like(length)
    opacity[ray] = 1.0
    normals = torch.nn.functional.normalize(gradient, dim=-1)
    return TileSamples(ray, points, normals, torch.ones_like(correction), opacity, length)
