"""Options of a fit to images, and what it reports."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_fit.options import NetworkOptions, grid_of_levels

Start = Literal["auto", "object", "room"]
"""The shape a field starts from: a ball in free space, a hollow ball in matter, or what the images
suggest (:mod:`.starting`)."""

OF_IMAGES = grid_of_levels(8)
"""Stands for the grid that the images ask for (:mod:`.capacity`), where no other one is given."""


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
    """The share of rays or of the map's points that are drawn from those at detail (:mod:`.detail`): where the surface
    is not flat, or in the boxes of the dataset's instances, if any; and the share of free points drawn from within
    these boxes."""
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
