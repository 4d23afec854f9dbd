"""Algorithm 1 of the paper: new samples near both surfaces, by random shifts of the old ones."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import ResamplingOptions
from regnf_core.paper.loss import SampleSet

_SPACING = 10.0  # a new sample keeps rho / 10 from all old ones


def field_radius(field: SdfField) -> float:
    """r: half the longest edge of the field's bounds; 1 for the usual bounds [-1, 1]^3."""
    return 0.5 * float((field.bounds[1] - field.bounds[0]).max())


def resample(
    samples: SampleSet,
    own: SdfField,
    other: SdfField,
    T_other_own: Sim3,
    options: ResamplingOptions,
    generator: torch.Generator,
) -> SampleSet:
    """The old samples and the shifted ones that Algorithm 1 accepts, at random at most ``max_samples`` of them.

    The conditions, cheapest first, so that the fields are evaluated at few points:
    distance to the old samples >= rho / 10, |S_own(x)| <= omega_1, |S_other(T x)| <= omega_2, r(x) <= xi.
    """
    rho = options.radius_fraction * field_radius(own)
    candidates = samples.points + rho * _uniform(samples.points, generator)
    spacing, _ = samples.neighbors.query(candidates)
    candidates = candidates[spacing >= rho / _SPACING]
    own_distance = own.signed_distance(candidates).to(candidates)
    near = own_distance.abs() <= options.own_distance
    candidates, own_distance = candidates[near], own_distance[near]
    other_distance = other.signed_distance(T_other_own.apply(candidates)).to(candidates)
    accepted = other_distance.abs() <= options.other_distance
    accepted &= (own_distance - other_distance).abs() <= options.residual
    points = torch.cat([samples.points, candidates[accepted]])
    distance = torch.cat([samples.own_distance, own_distance[accepted]])
    if points.shape[0] > options.max_samples:
        kept = torch.randperm(points.shape[0], generator=generator)[: options.max_samples].to(points.device)
        points, distance = points[kept], distance[kept]
    return SampleSet.from_distances(points, distance)


def _uniform(like: Tensor, generator: torch.Generator) -> Tensor:
    """U[-1, 1]^3 for each of the points (N, 3); drawn on the CPU, so that every device sees the same numbers."""
    return (2.0 * torch.rand(like.shape, generator=generator) - 1.0).to(like)
