"""What a fit draws from where there are depths: rays that end on a surface, and points known to be free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from regnf_core.geometry.box import OrientedBox
from regnf_fit.images.cells import cells_of
from regnf_fit.images.detail import in_boxes, uneven
from regnf_fit.images.map_distances import MapDistances
from regnf_fit.images.options import ReconstructionOptions
from regnf_fit.images.preparation import PreparedImages
from regnf_fit.images.rays import PixelRays, measured_within

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
    indices of those that end at detail · free_points: (P, 3), free by what was seen · clearances: (P,) their distance
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
        """The same on another device."""
        return DepthSupervision(
            rays=self.rays.to(device),
            before=self.before.to(device),
            behind=self.behind.to(device),
            noise=self.noise.to(device),
            trust=self.trust.to(device),
            detailed=self.detailed.to(device),
            free_points=self.free_points.to(device),
            clearances=self.clearances.to(device),
            size=self.size,
            near=None if self.near is None else self.near.to(device),
        )


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
    ends = surface.at(surface.depths[:, None])[:, 0]
    usual = float(before[inside].median()) if len(surface) else options.band * size
    cloud = _cloud(ends.numpy(), surface.deviations.numpy(), usual)
    free_to = torch.where(seen, rays.depths - before / rays.directions.norm(dim=1), rays.far).minimum(rays.far)
    is_open = (seen | rays.background) & (free_to > rays.near)
    points = _free_points(rays.take(is_open), free_to[is_open], prepared.boxes, options.detail_share, rng)
    return DepthSupervision(
        rays=surface,
        before=before[inside],
        behind=behind[inside],
        noise=_NOISE * spreads[inside],
        trust=_trust(surface.deviations),
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


def _trust(deviations: Tensor) -> Tensor:
    """What depths of these deviations (R,) count: the maximum likelihood of L1, within limits, 1 in the mean."""
    if len(deviations) == 0 or not bool((deviations > 0.0).all()):
        return torch.ones_like(deviations)
    weight = (deviations.median() / deviations).clamp(1.0 / _MAX_TRUST, _MAX_TRUST)
    return weight / weight.mean()


def _cloud(points: NDArray[np.float32], deviations: NDArray[np.float32], band: float) -> NDArray[np.float64]:
    """Averaged points (V, 3). Those too noisy for the band count only where no others are."""
    precise = deviations <= _PRECISE * band
    cloud, rough = (_averaged(points[chosen], _VOXEL * band) for chosen in (precise, ~precise))
    if len(cloud) == 0 or len(rough) == 0:
        return cloud if len(cloud) else rough
    alone = np.isinf(cKDTree(cloud).query(rough, distance_upper_bound=_ALONE * band)[0])
    return np.concatenate((cloud, rough[alone]))


def _averaged(points: NDArray[np.float32], voxel: float) -> NDArray[np.float64]:
    """One point (V, 3) for each occupied voxel: the mean of those within."""
    if len(points) == 0:
        return np.zeros((0, 3))
    given = torch.from_numpy(points)
    return np.asarray(cells_of(given, voxel).means(given))
