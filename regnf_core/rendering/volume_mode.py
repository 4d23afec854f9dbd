"""Volume rendering as in NeuS (Wang et al. 2021): opacity from the signed distances of consecutive samples.

alpha_i = max((Phi(s d_i) - Phi(s d_i+1)) / Phi(s d_i), 0), Phi the sigmoid (equation 13). Where the distance falls
along a ray, the products of 1 - alpha telescope: the transmittance does not depend on where the samples lie. So steps
are as long as sphere tracing allows, and about 1 / s where the opacity changes.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from regnf_core.rendering.samples import TileSamples
from regnf_core.rendering.tracing import Region, Start
from regnf_core.surface.cameras import Rays

Medium = Callable[[Tensor], tuple[Tensor, Tensor]]
"""The distance (N,) and the inverse deviation s (N,) at points (N, 3), per scene unit."""
CLEAR = 4.0
"""s d up to which steps are long: the opacity between two samples depends on their distances alone, so nothing of it is
lost; only its place would be less exact."""
_FINE = 1.0
"""How much s d changes in a step below that, about."""
_SLOWEST = 0.5
"""Least change of the distance along a ray, per length, that steps are told by."""
_SHARE = 0.9
_MOST_STEPS = 1024
_OPAQUE = 5e-3
"""Transmittance at which a ray ends."""
_LEAST_WEIGHT = 0.03
"""Of samples that are shaded, as a share of their ray's opacity; the others' weight is shared out among them."""
_LEAST_OPACITY = 1e-3
"""What is less opaque is not seen."""


def volume_samples(region: Region, rays: Rays, start: Start, medium: Medium, least: float) -> TileSamples:
    """The samples of all rays that add to what is seen, and the mean length of each ray by weight.

    medium: of the field · least: s anywhere.
    """
    count = len(rays.origins)
    passed = rays.origins.new_ones(count)
    weighted = torch.zeros_like(passed)
    kept: list[tuple[Tensor, Tensor, Tensor]] = []
    index = (region.exit > start.length).nonzero().squeeze(-1)
    t = start.length[index]
    last_t, last_d, last_s = t.clone(), torch.full_like(t, torch.nan), torch.ones_like(t)
    for _ in range(_MOST_STEPS):
        if index.numel() == 0:
            break
        points = rays.origins[index] + t[:, None] * rays.directions[index]
        d, s = _distance(region, points, medium, least)
        alpha = _alpha(last_s * last_d, last_s * d)
        weight = passed[index] * alpha
        passed[index] = passed[index] * (1.0 - alpha)
        middle = last_t + (t - last_t) * _mean_share(last_s * last_d, s * d)
        weighted[index] += weight * middle
        seen = weight > _LEAST_OPACITY
        kept.append((index[seen], middle[seen], weight[seen]))
        approach = ((last_d - d).abs() / (t - last_t).clamp_min(1e-12)).nan_to_num(1.0).clamp(_SLOWEST, 1.0)
        onward = torch.maximum(_SHARE * (d - CLEAR / s), _FINE / (s * approach)).clamp_min(region.shortest / 4)
        last_t, last_d, last_s, t = t, d, s, t + onward
        going = (passed[index] > _OPAQUE) & (last_t < region.exit[index])
        index, t, last_t, last_d, last_s = (part[going] for part in (index, t, last_t, last_d, last_s))
    opacity = 1.0 - passed
    length = weighted / opacity.clamp_min(1e-6)
    return _shaded_samples(region, rays, kept, opacity, length)


def _distance(region: Region, points: Tensor, medium: Medium, least: float) -> tuple[Tensor, Tensor]:
    """Distance and s (N,): the field's where the opacity may change, a lower bound and ``least`` elsewhere."""
    distance = region.grid.at(points)
    s = torch.full_like(distance, least)
    asked = (distance <= 2.0 * CLEAR / least).nonzero().squeeze(-1)
    distance[asked], s[asked] = medium(points[asked])
    return distance, s


def _alpha(before: Tensor, after: Tensor) -> Tensor:
    """(N,), of s times the distances; 0 where there is no sample before."""
    # Phi(a) - Phi(b) over Phi(a) = 1 - Phi(b) / Phi(a), in logarithms: exact far inside matter as well
    alpha = -torch.expm1(torch.nn.functional.logsigmoid(after) - torch.nn.functional.logsigmoid(before))
    return torch.nan_to_num(alpha, nan=0.0).clamp(0.0, 1.0)


def _mean_share(before: Tensor, after: Tensor) -> Tensor:
    """(N,), 0..1: the mean place of a segment's opacity, of s times the distances at its ends, linear between them.

    With T = Phi(d) / Phi(before) the transmittance, the mean is the integral of T less its last value, over its fall;
    and the integral of the sigmoid is softplus.
    """
    a, b = before.double(), after.double()
    fall = torch.sigmoid(a) - torch.sigmoid(b)
    integral = (torch.nn.functional.softplus(a) - torch.nn.functional.softplus(b)) / (a - b)
    share = (integral - torch.sigmoid(b)) / fall
    return torch.where((fall > 1e-9) & ((a - b) > 1e-4), share, 0.5).clamp(0.0, 1.0).to(before)


def _shaded_samples(
    region: Region, rays: Rays, kept: list[tuple[Tensor, Tensor, Tensor]], opacity: Tensor, length: Tensor
) -> TileSamples:
    empty = opacity.new_zeros(0)
    parts = kept or [(empty.long(), empty, empty)]
    ray, t, weight = (torch.cat(values) for values in zip(*parts, strict=True))
    shaded = weight > _LEAST_WEIGHT * opacity[ray]
    ray, t, weight = ray[shaded], t[shaded], weight[shaded]
    total = torch.zeros_like(opacity).index_add_(0, ray, weight)
    weight = weight * (opacity / total.clamp_min(1e-9))[ray]
    opacity = torch.where(total > 0, opacity, 0.0)
    points = rays.origins[ray] + t[:, None] * rays.directions[ray]
    gradient = region.field.signed_distance_and_gradient(points)[1].to(points)
    return TileSamples(ray, points, torch.nn.functional.normalize(gradient, dim=-1), weight, opacity, length)
