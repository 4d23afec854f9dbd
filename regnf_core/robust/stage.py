"""One stage of a coarse-to-fine refinement: how many samples, which kernel widths, which poses go on."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    """Refine all poses on ``points`` samples of each surface, then keep the best ones.

    widths: kernel widths, one iteration each, object diameters; without any, poses are only scored · score_width:
    kernel width of the score · keep: at most so many poses · min_distance: between two kept poses, object diameters ·
    margin: kept poses score no worse than the best one plus this · adaptive: ``widths`` are lower limits, see
    :func:`regnf_core.robust.refine.loss.adaptive_width` · copies: of each pose, moved at random, that are refined with
    it.
    """

    points: int
    widths: tuple[float, ...]
    score_width: float
    keep: int
    min_distance: float = 0.0
    margin: float = math.inf
    adaptive: bool = False
    copies: int = 0
