"""Options of all fits: the size of the network, its training, and the progress callback."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from regnf_core.schema.hash_grid_config import HashGridConfig

FitProgress = Callable[[int, float, float], None]
"""Called regularly with the iteration, its loss and an estimate of the remaining seconds. It may raise an error to stop
the fit."""


def grid_of_levels(levels: int, nodes: int = 512, log2_table_size: int = 15) -> HashGridConfig:
    """Return a hash grid with this number of levels, from 16 to ``nodes`` nodes along an edge, with at most
    2^log2_table_size entries per level."""
    return HashGridConfig.from_top_resolution(
        nodes, levels=levels, features_per_level=2, log2_table_size=log2_table_size, base_resolution=16
    )


@dataclass(frozen=True)
class NetworkOptions:
    """Size and training of the network of a fitted field."""

    grid: HashGridConfig = field(default_factory=lambda: grid_of_levels(10))
    """The hash grid over [-2, 2]^3. More entries and a finer top level keep thinner parts, but give a larger file."""
    hidden_layers: int = 2
    hidden_width: int = 128
    iterations: int = 3000
    table_rate: float = 1e-2
    network_rate: float = 2e-3
    final_rate: float = 0.01
    """The share of the initial learning rates at the end of their cosine decay."""
    half_table: bool = True
    """Store the hash table in half precision. The file has half the size, and distances change by less than 1e-4."""

    def rate_share(self, iteration: int) -> float:
        """The share of the learning rates that is left at ``iteration``: a cosine from 1 down to ``final_rate``."""
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(iteration / self.iterations, 1.0)))
        return self.final_rate + (1.0 - self.final_rate) * cosine


# Options of a fit to a mesh, and what it reports.


@dataclass(frozen=True)
class FitOptions(NetworkOptions):
    """Options of a fit to a mesh. Lengths are relative to the target's diagonal, so they apply to a cup and to a
    room."""

    hidden_width: int = 128
    """neus-facto has 256. Half the width halves the time of a registration and loses little accuracy."""
    batch: int = 6144
    """Number of points per iteration for the distances."""
    gradient_batch: int = 2048
    """Number of points per iteration near the surface, for distance and gradient."""
    gradient_weight: float = 0.02
    """Weight of the squared error of the gradient, relative to the absolute error of the distance divided by the
    diagonal."""
    near_points: int = 600_000
    """Number of points near the surface in the pool of exact distances."""
    volume_points: int = 200_000
    """Number of points anywhere in the padded bounds in the pool."""
    noise: tuple[float, ...] = (0.002, 0.01, 0.04)
    """Standard deviations of the distance of the near points from the surface. Each one has an equal share of the
    points."""
    padding: float = 0.25
    """Width of the region around the target's bounds in which the field is fitted."""
    margin: float = 0.05
    """Distance of the bounds of the written field from the target's bounds."""


@dataclass(frozen=True)
class FitReport:
    """Errors of a fitted field, on new points near the surface, relative to the diagonal."""

    mean_error: float
    p95_error: float
    max_error: float
    volume_mean_error: float
    """The mean error anywhere in the padded bounds."""
    mean_gradient_norm: float
    mean_normal_cosine: float
    """Mean cosine between the field's gradient and the exact one. Both means are over points in free space, because a
    mesh of overlapping parts has internal surfaces that a field should not reproduce."""
    diagonal: float
    """The target's diagonal in its own unit. The errors are relative to it."""
    iterations: int
    seconds: float


# Options of a fit to images, and what it reports.

Start = Literal["auto", "object", "room"]
"""The initial shape of a field: a ball in free space, a hollow ball in solid matter, or a choice from the images
(`images/preparation.py`)."""

OF_IMAGES = grid_of_levels(8)
"""Default: the grid is chosen from the images (`images/fit.py`)."""


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms. docs/fitting.md describes the terms and their sources.

    Lengths are relative to the diagonal of the bounds, so the weights apply to a cup and to a room.
    """

    color: float = 1.0
    eikonal: float = 0.4
    """The paper's lambda, against a color term of weight 1."""
    surface: float = 200.0
    """|signed distance| at measured depths, and the distance along the ray near them."""
    surface_with_poses: float = 20.0
    """The same weight if poses are refined. It is lower, because depths of wrong poses must not fix the shape."""
    map: float = 200.0
    """In rooms, instead: |signed distance - that of the map of all depths| near surfaces."""
    free_space: float = 10.0
    rendered_depth: float = 2.0
    opacity: float = 0.1
    """Rays in the background of the mask are transparent, the others opaque. Only without depth."""
    poses: float = 0.001
    """Mean square of the pose corrections, in units of their expected deviations."""


@dataclass(frozen=True)
class ReconstructionOptions(NetworkOptions):
    """Options of a fit to images. Lengths are relative to the diagonal of the bounds."""

    grid: HashGridConfig = OF_IMAGES
    """The hash grid over [-2, 2]^3. Default: 512 to 1024 nodes along an edge and 2^15 to 2^18 entries per level,
    depending on the images."""
    table_log2: int | None = None
    """log2 of the number of entries per level; None: chosen from the images."""
    hidden_width: int = 64
    feature_width: int = 16
    """Number of features from the geometry network to the color network."""
    map_points: int = 4096
    """Number of points near surfaces per iteration. Their distances are from the map of all depths."""
    surface_rays: int = 1024
    """Rays with depth an iteration; each gives one point at the surface, within the noise, and ``band_samples`` beside
    it."""
    band_samples: int = 3
    free_points: int = 1024
    eikonal_points: int = 512
    """Points an iteration for the Eikonal term, half of them near surfaces, half anywhere in the bounds."""
    color_rays: int = 64
    """Rays for color, where there is depth, every eighth iteration. The geometry learns from it where poses are
    corrected alone; then it is every iteration."""
    rays_without_depth: int = 384
    """The same where there is none: color is all there is to learn from."""
    band_deviations: float = 5.0
    """How far before a measured surface the distance along the ray is believed, in standard deviations of the depth's
    noise, or a pixel's width there if that is more; half as far behind it."""
    band: float = 0.012
    """At most so far before it, but for ``band_spreads``."""
    band_behind: float = 0.006
    """At most so far behind it, but for ``band_spreads``: half of the thinnest part worth having."""
    band_spreads: float = 6.0
    """At least so far before it, in standard deviations of one image's depths from another's, and half as far behind:
    the sensor's noise and the poses' errors, which the images themselves show."""
    detail_share: float = 0.5
    """The share of rays or of the map's points that are drawn from those at detail (`images/preparation.py`): where the
    surface is not flat, or in the boxes of the dataset's instances, if any; and the share of free points drawn from
    within these boxes."""
    weights: LossWeights = field(default_factory=LossWeights)
    levels_at_start: int = 4
    """Number of grid levels that learn from the first iteration. The finer levels follow one by one."""
    level_interval: float = 0.03
    """Share of the iterations from one level to the next."""
    averaging: float = 0.99
    """Decay of the moving average of the parameters. The average is written to the file. 0: no average."""
    start: Start = "auto"
    refine_poses: bool = False
    """Refine the camera poses together with the field, if there are depths: one rotation and one translation per
    image."""
    pose_rate: float = 0.1
    """Learning rate of the corrections, in units of the expected deviations of the poses."""
    poses_from: float = 0.15
    """Share of the iterations after which poses are refined. Earlier, the shape is too coarse."""
    observation_voxels: int = 192
    """Number of voxels along the longest side of the observation grid, if there are depths; 0: no observation is
    stored."""

    def learning_levels(self, iteration: int) -> int:
        """How many of the grid's levels learn at ``iteration``, coarsest first."""
        steps = iteration / (self.level_interval * self.iterations) if self.level_interval > 0.0 else math.inf
        return self.grid.levels if math.isinf(steps) else min(self.levels_at_start + int(steps), self.grid.levels)

    def decay(self, iteration: int) -> float:
        """Of the moving average at ``iteration``: less at first, so that the start is soon forgotten."""
        return min(self.averaging, (1.0 + iteration) / (10.0 + iteration))


@dataclass(frozen=True)
class ReconstructionReport:
    """How well a field agrees with pixels that it was not fitted to."""

    loss: float
    """Mean over the last iterations."""
    psnr: float | None
    """PSNR between pictures of the field and images that the fit did not use, decibels, at pixels of the object. None:
    no such image."""
    ssim: float | None
    """Their mean structural similarity, up to 1."""
    depth_error: float | None
    """Mean |rendered - measured depth|, field units, at pixels that have both and whose view of the bounds is free.
    None without depth. It includes sensor noise."""
    depth_error_median: float | None
    eikonal_error: float
    """Mean ||gradient| - 1| near the surface."""
    pose_shift: float | None
    """Median translation of the corrected cameras, field units. None: poses were not refined."""
    iterations: int
    seconds: float
    warnings: tuple[str, ...]
    """Warnings. Each begins with a stable word."""
