"""What measured depths say about the signed distance.

Near the measured surface the distance along the ray and free space before it, as Azinovic et al. (2022, "Neural RGB-D
Surface Reconstruction") have it, with two changes for a field that shall be a distance, not one along a ray: the
distance along the ray is shortened by the cosine between ray and surface, and free points are given their distance to
the nearest measured surface (as Ortiz et al. 2022, "iSDF") in place of the truncation. In rooms, unless poses are
corrected, the map that all depths fuse to (:mod:`.map_distances`) tells distances near surfaces instead of single rays.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from regnf_core.fields.neus_facto_function import NeusFactoFunction
from regnf_fit.images.depth_supervision import DepthSupervision
from regnf_fit.images.map_distances import MapDistances
from regnf_fit.images.options import ReconstructionOptions
from regnf_fit.images.rays import PixelRays

_MORE_MATTER = 0.3
"""What an error counts behind a surface and beyond the noise, when a point is less deep than the ray says: the part may
be thin."""
_PLACES_BEHIND = 1.0 / 3.0
"""The share of the points beside a surface that lie behind it: as dense as before it, where the band is twice as
wide."""


def depth_terms(
    function: NeusFactoFunction,
    data: DepthSupervision,
    options: ReconstructionOptions,
    generator: torch.Generator,
    correct: Callable[[PixelRays], PixelRays] = lambda rays: rays,
) -> tuple[Tensor, Tensor, Tensor]:
    """The surface's term and that of free space, in diagonals, and the points (N, 3) on and near the surface.

    correct: the rays by corrected poses, which the surface's term is differentiable by.
    """
    if data.near is not None:
        return _map_terms(function, data, data.near, options, generator)
    chosen = _draw_rays(data, options, generator)
    rays = correct(data.rays.take(chosen))
    noise = torch.where(rays.cosines > 0.0, data.noise[chosen], 0.0)
    offsets = _offsets(data.before[chosen], data.behind[chosen], noise, options.band_samples, generator)
    cosines = torch.where(rays.cosines > 0.0, rays.cosines, 1.0)
    depths = rays.depths[:, None] - offsets / rays.directions.norm(dim=1, keepdim=True)
    near = rays.at(depths)  # (R, 1 + B, 3)
    free = _draw(len(data.free_points), options.free_points, generator, data.free_points.device)
    values = function.value(torch.cat((near.flatten(0, 1), data.free_points[free])))
    beside, beyond = values[: offsets.numel()].view_as(offsets), values[offsets.numel() :]
    error = beside - offsets * cosines[:, None]
    behind = offsets < -noise[:, None]
    weight = torch.where(behind & (error > 0.0), _MORE_MATTER, 1.0) * data.trust[chosen, None]
    # where no plane could be laid, only the surface itself is believed
    weight[:, 1:] *= (rays.cosines > 0.0)[:, None]
    surface = (weight * error.abs()).mean() / data.size
    return surface, _free_space(beyond, data, free), near.detach().flatten(0, 1)


def _map_terms(
    function: NeusFactoFunction,
    data: DepthSupervision,
    near: MapDistances,
    options: ReconstructionOptions,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """The terms where a map of the images tells the distances near surfaces: |value - the map's| in place of rays."""
    device = near.points.device
    count = int(options.detail_share * options.map_points) if len(near.detailed) else 0
    detailed = near.detailed[_draw(len(near.detailed), count, generator, device)]
    chosen = torch.cat((detailed, _draw(len(near.points), options.map_points - count, generator, device)))
    points, free = near.points[chosen], _draw(len(data.free_points), options.free_points, generator, device)
    values = function.value(torch.cat((points, data.free_points[free])))
    surface = (values[: len(points)] - near.distances[chosen]).abs().mean() / data.size
    return surface, _free_space(values[len(points) :], data, free), points


def _free_space(values: Tensor, data: DepthSupervision, free: Tensor) -> Tensor:
    """|value - distance to the nearest measured surface| of the free points ``free`` (F,), in diagonals."""
    total: Tensor = (values - data.clearances[free]).abs().sum()
    return total / max(len(free), 1) / data.size


def _draw_rays(data: DepthSupervision, options: ReconstructionOptions, generator: torch.Generator) -> Tensor:
    """Indices of the rays of one iteration: a share of those that end in instances' boxes, and any."""
    device = data.free_points.device
    count = int(options.detail_share * options.surface_rays) if len(data.detailed) else 0
    detailed = data.detailed[_draw(len(data.detailed), count, generator, device)]
    return torch.cat((detailed, _draw(len(data.rays), options.surface_rays - count, generator, device)))


def _offsets(before: Tensor, behind: Tensor, noise: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """(R, 1 + count): about where the ray ends, then distances along it before the end (positive) and behind.

    The first lies up to ``noise`` from the end. Wrong depths that all said "surface" where they end would say so of
    places before and behind the surface, and no distance would be learned within the noise.
    """

    def share(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator).to(before.device)

    is_behind = share(len(before), count) < _PLACES_BEHIND
    beside = torch.where(is_behind, -behind[:, None], before[:, None]) * share(len(before), count)
    return torch.cat((noise[:, None] * (2.0 * share(len(before), 1) - 1.0), beside), dim=1)


def _draw(pool: int, count: int, generator: torch.Generator, device: torch.device) -> Tensor:
    return torch.randint(max(pool, 1), (count if pool else 0,), generator=generator).to(device)
