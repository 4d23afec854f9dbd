"""What all fits have in common: the size of the network, its training, and how progress is told."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from regnf_core.schema.hash_grid_config import HashGridConfig

FitProgress = Callable[[int, float, float], None]
"""Called from time to time with the iteration, its loss and an estimate of the seconds left. May raise to stop."""


def grid_of_levels(levels: int, nodes: int = 512, log2_table_size: int = 15) -> HashGridConfig:
    """Return a hash grid of so many levels, from 16 to ``nodes`` along an edge, with at most 2^log2_table_size entries
    a level."""
    return HashGridConfig.from_top_resolution(
        nodes, levels=levels, features_per_level=2, log2_table_size=log2_table_size, base_resolution=16
    )


@dataclass(frozen=True)
class NetworkOptions:
    """Size and training of the network of a field that is fitted."""

    grid: HashGridConfig = field(default_factory=lambda: grid_of_levels(10))
    """The hash grid over [-2, 2]^3: more entries and a finer top level keep thinner parts, in a larger file."""
    hidden_layers: int = 2
    hidden_width: int = 128
    iterations: int = 3000
    table_rate: float = 1e-2
    network_rate: float = 2e-3
    final_rate: float = 0.01
    """The share of the learning rates that is left at the end of their cosine decay."""
    half_table: bool = True
    """Store the hash table in half precision: half the file, and distances change by less than 1e-4."""

    def rate_share(self, iteration: int) -> float:
        """The share of the learning rates that is left at ``iteration``: a cosine from 1 down to ``final_rate``."""
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(iteration / self.iterations, 1.0)))
        return self.final_rate + (1.0 - self.final_rate) * cosine


# Options of a fit to a mesh, and what it reports.


@dataclass(frozen=True)
class FitOptions(NetworkOptions):
    """How a field is fitted. Lengths are shares of the target's diagonal, so that they suit a cup and a room alike."""

    hidden_width: int = 128
    """neus-facto itself has 256; half of that halves the cost of a registration and loses little."""
    batch: int = 6144
    """Points an iteration, for the distances."""
    gradient_batch: int = 2048
    """Points an iteration, near the surface, for distance and gradient."""
    gradient_weight: float = 0.02
    """Weight of the gradient's squared error against the distance's absolute error over the diagonal."""
    near_points: int = 600_000
    """Points near the surface in the pool of exact distances."""
    volume_points: int = 200_000
    """Points anywhere in the padded bounds in the pool."""
    noise: tuple[float, ...] = (0.002, 0.01, 0.04)
    """Standard deviations of the near points' distance from the surface; an equal share of the points for each."""
    padding: float = 0.25
    """How far beyond the target's bounds the field is fitted."""
    margin: float = 0.05
    """How far beyond the target's bounds the written field's own bounds lie."""


@dataclass(frozen=True)
class FitReport:
    """How well a field agrees with the exact one, on fresh points near the surface; errors in diagonals."""

    mean_error: float
    p95_error: float
    max_error: float
    volume_mean_error: float
    """The same anywhere in the padded bounds."""
    mean_gradient_norm: float
    mean_normal_cosine: float
    """Mean cosine between the field's gradient and the exact one. Both means are over points in free space: a mesh of
    overlapping parts has creases inside that no field should reproduce."""
    diagonal: float
    """The target's diagonal, own units: what the errors are shares of."""
    iterations: int
    seconds: float


# Options of a fit to images, and what it reports.

Start = Literal["auto", "object", "room"]
"""The shape a field starts from: a ball in free space, a hollow ball in matter, or what the images
suggest (`images/preparation.py`)."""

OF_IMAGES = grid_of_levels(8)
"""Stands for the grid that the images ask for (`images/fit.py`), where no other one is given."""


@dataclass(frozen=True)
class LossWeights:
    """What each term counts; docs/fitting.md says what it does and where it comes from.

    Lengths are measured in diagonals of the bounds, so that a cup and a room are weighted alike.
    """

    color: float = 1.0
    eikonal: float = 0.4
    """The paper's lambda, against a color term of weight 1."""
    surface: float = 200.0
    """|signed distance| where a depth was measured, and the distance along the ray near it."""
    surface_with_poses: float = 20.0
    """The same where poses are corrected: what depths of wrong poses say must not hold the shape."""
    map: float = 200.0
    """In rooms, instead: |signed distance - that of the map of all depths| near surfaces."""
    free_space: float = 10.0
    rendered_depth: float = 2.0
    opacity: float = 0.1
    """Rays of the mask's background let through, the others not; without depth alone."""
    poses: float = 0.001
    """Mean square of the poses' corrections, in the deviations that are expected of them."""


@dataclass(frozen=True)
class ReconstructionOptions(NetworkOptions):
    """How a field is fitted to images. Lengths are shares of the bounds' diagonal."""

    grid: HashGridConfig = OF_IMAGES
    """Over [-2, 2]^3. As it stands here: from 512 to 1024 nodes along an edge and 2^15 to 2^18 entries a level, by what
    the images show."""
    table_log2: int | None = None
    """log2 of that grid's entries a level; None: by what the images show."""
    hidden_width: int = 64
    feature_width: int = 16
    """What the geometry's network hands to the color's."""
    map_points: int = 4096
    """Points near surfaces an iteration, where the map of all depths tells their distances."""
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
    """The grid's levels that learn from the first iteration on; the finer ones follow one by one."""
    level_interval: float = 0.03
    """The share of the iterations from one level to the next."""
    averaging: float = 0.99
    """Decay of the moving average of the parameters, which is what is written; 0 for none."""
    start: Start = "auto"
    refine_poses: bool = False
    """Correct the cameras' poses with the field, where there are depths: by a rotation and a shift an image."""
    pose_rate: float = 0.1
    """Learning rate of the corrections, in the deviations that are expected of the poses."""
    poses_from: float = 0.15
    """The share of the iterations from which on poses are corrected: before it, the shape is too coarse."""
    observation_voxels: int = 192
    """Voxels along the longest side of the grid of what was observed, where there are depths; 0: none is kept."""

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
    """Of the field's pictures to whole images held out, decibels, where they show the thing; None: none was."""
    ssim: float | None
    """Their mean structural similarity, up to 1."""
    depth_error: float | None
    """Mean |rendered - measured depth|, field units, where both are and nothing before the bounds hides what is in
    them; None without depth. Sensor noise is part of it."""
    depth_error_median: float | None
    eikonal_error: float
    """Mean ||gradient| - 1| near the surface."""
    pose_shift: float | None
    """Median shift of the corrected cameras, field units; None: poses were not corrected."""
    iterations: int
    seconds: float
    warnings: tuple[str, ...]
    """Each begins with a stable word."""
