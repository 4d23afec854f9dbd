"""One stage of a coarse-to-fine refinement: how many samples, which kernel widths, which poses go on."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    """Refine all poses on ``points`` samples of each surface, then keep the best ones.

    widths: kernel widths, one iteration each, object diameters; without any, poses are only scored · score_width:
    kernel width of the score · keep: at most so many poses · min_distance: between two kept poses, object diameters ·
    margin: kept poses score no worse than the best one plus this · widest: where the residuals' spread asks for it,
    kernels are wider than ``widths``, up to this, see :func:`regnf_core.robust.refine.loss.adaptive_width`; 0: they are
    not · keeps_scale: no pose's scale changes · normals: whether the loss that is minimized counts them · copies: of
    each pose that are refined with it, moved at random ·
    spread: standard deviations of their rotation (radians), translation (diameters) and log scale.
    """

    points: int
    widths: tuple[float, ...]
    score_width: float
    keep: int
    min_distance: float = 0.0
    margin: float = math.inf
    widest: float = 0.0
    keeps_scale: bool = False
    normals: bool = True
    copies: int = 0
    spread: tuple[float, float, float] = (0.0, 0.0, 0.0)
