"""What a fit draws from where there are depths: rays that end on a surface, and points known to be free."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from regnf_core.fields.neus_facto_function import NeusFactoFunction
from regnf_core.geometry.box import OrientedBox
from regnf_fit.images.fusion import MapDistances
from regnf_fit.images.preparation import (
    PixelRays,
    PreparedImages,
    cells_of,
    ends_of,
    in_boxes,
    measured_within,
    on_device,
    uneven,
)
from regnf_fit.options import ReconstructionOptions

_FREE_POOL = 400_000
_CANDIDATES = 3
"""So many times the pool are drawn where those near instances are to be chosen from them."""
_VOXEL = 2.0 / 3.0
"""Bands: measured points closer together than this are averaged before distances to them are taken."""
_PRECISE = 0.25
"""Bands: the noise up to which a point shows where the surface is."""
_ALONE = 3.0
"""Bands: noisier points count where no precise one is as near as this."""
_NOISE = 3.0
"""Standard deviations of one image's depths from another's: so far off may a depth be."""
_STEEPEST = 0.3
"""Cosines of rays and normals count as no less."""
_MAX_TRUST = 4.0
"""At the most a depth counts so many times what the median one does, or so many times less."""


@dataclass(frozen=True)
class DepthSupervision:
    """What is drawn from in every iteration; lengths in field units.

    rays: (R,) those with depth · before, behind: (R,) how far along them the band reaches before and behind the surface
    · noise: (R,) how far off along them their ends may be · trust: (R,) what they count, 1 in the mean · detailed: (D,)
    indices of those that end at detail · free_points: (P, 3), observed free space · clearances: (P,) their distance
    to the nearest measured surface · size: the bounds' diagonal · near: what the map of all depths says, if that is
    learned in place of rays.
    """

    rays: PixelRays
    before: Tensor
    behind: Tensor
    noise: Tensor
    trust: Tensor
    detailed: Tensor
    free_points: Tensor
    clearances: Tensor
    size: float
    near: MapDistances | None = None

    def to(self, device: torch.device) -> DepthSupervision:
        return on_device(self, device)


def supervise(prepared: PreparedImages, options: ReconstructionOptions, rng: np.random.Generator) -> DepthSupervision:
    """The pool of rays with depth whose surface lies in the bounds, and of points known to be free."""
    rays, size = prepared.training, prepared.size
    # depths are distinguished from the surface by their noise, or by the width of a pixel there
    bands = torch.maximum(options.band_deviations * rays.deviations, prepared.pixel * rays.depths)
    before, behind = bands.clamp_max(options.band * size), (0.5 * bands).clamp_max(options.band_behind * size)
    # Within so many deviations the images contradict each other: a narrower band would be torn between them. They are
    # measured across the surface; along a ray that meets it at a grazing angle, depths differ by more.
    cosines = torch.where(rays.cosines > 0.0, rays.cosines.clamp_min(_STEEPEST), 1.0)
    spreads = torch.from_numpy(prepared.spread.at(rays.depths.numpy())) / cosines
    before = before.maximum(options.band_spreads * spreads)
    behind = behind.maximum(0.5 * options.band_spreads * spreads)
    seen = (rays.depths > 0.0) & ~rays.background
    inside = measured_within(rays)
    surface = rays.take(inside)
    ends = ends_of(surface)
    usual = float(before[inside].median()) if len(surface) else options.band * size
    cloud = _cloud(ends.numpy(), surface.deviations.numpy(), usual)
    free_to = torch.where(seen, rays.depths - before / rays.directions.norm(dim=1), rays.far).minimum(rays.far)
    is_open = (seen | rays.background) & (free_to > rays.near)
    points = _free_points(rays.take(is_open), free_to[is_open], prepared.boxes, options.detail_share, rng)
    # what depths count: the maximum likelihood of L1, within limits, 1 in the mean
    trust = torch.ones_like(surface.deviations)
    if len(surface) and bool((surface.deviations > 0.0).all()):
        weight = (surface.deviations.median() / surface.deviations).clamp(1.0 / _MAX_TRUST, _MAX_TRUST)
        trust = weight / weight.mean()
    return DepthSupervision(
        rays=surface,
        before=before[inside],
        behind=behind[inside],
        noise=_NOISE * spreads[inside],
        trust=trust,
        detailed=(in_boxes(prepared.boxes, ends) | uneven(ends, surface.deviations, size)).nonzero()[:, 0],
        free_points=points,
        clearances=torch.from_numpy(cKDTree(cloud).query(points.numpy())[0].astype(np.float32)),
        size=size,
    )


def _free_points(
    rays: PixelRays, free_to: Tensor, boxes: Sequence[OrientedBox], detail_share: float, rng: np.random.Generator
) -> Tensor:
    """(P, 3) anywhere on the rays up to depths (R,), ``detail_share`` of them within the boxes if there are enough."""
    if len(rays) == 0:
        return torch.zeros(0, 3)
    chosen = torch.from_numpy(rng.integers(len(rays), size=_FREE_POOL * (_CANDIDATES if boxes else 1)))
    share = torch.from_numpy(rng.random(len(chosen), np.float32))
    picked = rays.take(chosen)
    points = picked.at((picked.near + share * (free_to[chosen] - picked.near))[:, None])[:, 0]
    within = in_boxes(boxes, points).nonzero()[:, 0][: int(detail_share * _FREE_POOL)]
    return torch.cat((points[within], points[: _FREE_POOL - len(within)]))


def _cloud(points: NDArray[np.float32], deviations: NDArray[np.float32], band: float) -> NDArray[np.float64]:
    """Averaged points (V, 3). Those too noisy for the band count only where no others are."""

    def averaged(given: Tensor) -> NDArray[np.float64]:
        """One point (V, 3) for each occupied voxel: the mean of those within."""
        return np.asarray(cells_of(given, _VOXEL * band).means(given)) if len(given) else np.zeros((0, 3))

    precise = torch.from_numpy(deviations <= _PRECISE * band)
    cloud, rough = (averaged(torch.from_numpy(points)[chosen]) for chosen in (precise, ~precise))
    if len(cloud) == 0 or len(rough) == 0:
        return cloud if len(cloud) else rough
    alone = np.isinf(cKDTree(cloud).query(rough, distance_upper_bound=_ALONE * band)[0])
    return np.concatenate((cloud, rough[alone]))


# What measured depths say about the signed distance.
#
# Near the measured surface the distance along the ray and free space before it, as Azinovic et al. (2022, "Neural
# RGB-D Surface Reconstruction") have it, with two changes for a field that shall be a distance, not one along a ray:
# the distance along the ray is shortened by the cosine between ray and surface, and free points are given their
# distance to the nearest measured surface (as Ortiz et al. 2022, "iSDF") in place of the truncation. In rooms, unless
# poses are corrected, the map that all depths fuse to (`fusion.py`) tells distances near surfaces instead
# of single rays.

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
    chosen = _draw_some_at_detail(len(data.rays), data.detailed, options.surface_rays, options, generator)
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
    chosen = _draw_some_at_detail(len(near.points), near.detailed, options.map_points, options, generator)
    points = near.points[chosen]
    free = _draw(len(data.free_points), options.free_points, generator, points.device)
    values = function.value(torch.cat((points, data.free_points[free])))
    surface = (values[: len(points)] - near.distances[chosen]).abs().mean() / data.size
    return surface, _free_space(values[len(points) :], data, free), points


def _free_space(values: Tensor, data: DepthSupervision, free: Tensor) -> Tensor:
    """|value - distance to the nearest measured surface| of the free points ``free`` (F,), in diagonals."""
    total: Tensor = (values - data.clearances[free]).abs().sum()
    return total / max(len(free), 1) / data.size


def _draw_some_at_detail(
    pool: int, detailed: Tensor, count: int, options: ReconstructionOptions, generator: torch.Generator
) -> Tensor:
    """(count,) of ``pool`` numbers: a share of those that are ``detailed`` (D,), and any."""
    device = detailed.device
    few = int(options.detail_share * count) if len(detailed) else 0
    chosen = detailed[_draw(len(detailed), few, generator, device)]
    return torch.cat((chosen, _draw(pool, count - few, generator, device)))


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
