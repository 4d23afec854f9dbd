"""The refinement on the fields.

The package's docstring explains the sources.
"""

from __future__ import annotations

from dataclasses import dataclass

from regnf_core.robust.stage import Stage

_LAST_STAGES = (
    Stage(
        points=700,
        widths=(0.02, 0.02, 0.015, 0.01) + (0.008,) * 3,
        score_width=0.015,
        keep=8,
        min_distance=0.03,
        margin=1.0,
        widest=0.04,
        normals=False,
    ),
    Stage(
        points=700,
        widths=(0.015, 0.01, 0.01, 0.008, 0.008),
        score_width=0.015,
        keep=8,
        min_distance=0.03,
        margin=1.0,
        widest=0.02,
        normals=False,
    ),
)


@dataclass(frozen=True)
class RefinementConstants:
    """Levenberg-Marquardt on the fields (refine/)."""

    stages: tuple[Stage, ...] = (
        Stage(200, (0.05, 0.04, 0.03, 0.02, 0.02), 0.02, keep=10, min_distance=0.03, margin=0.15, widest=0.04),
        Stage(300, (0.02, 0.015, 0.01, 0.01), 0.015, keep=6, min_distance=0.03, margin=0.10, widest=0.04),
    )
    """On all pose candidates. The first stage was chosen together with the last one of the search, which uses the wider
    kernels. [by hand, the first and the numbers kept on random worlds]"""
    last_stages: tuple[Stage, ...] = _LAST_STAGES
    """On what is left, and the best pose's symmetry equivalents. Wide kernels find the pose among rough surfaces,
    narrow ones keep what is close by from drawing it away. Normals do not count: the cost is smooth without them.
    The first begins with wider kernels: narrow ones have minima close to each other, in which poses of other seeds
    would end. [by hand, the second on random worlds]"""
    same_pose: float = 0.06
    """Diameters. A symmetry equivalent closer to a pose that is there already is not added. [by hand]"""
    damping_start: float = 1e-2
    """Damping of the first iteration, relative to the diagonal of the normal equations. [by hand]"""
    damping_range: tuple[float, float] = (1e-7, 1e4)
    """The damping stays within. [by hand]"""
    damping_decrease: float = 6.0
    """The damping is divided by this after a step that lowers the cost. [by hand]"""
    damping_increase: float = 5.0
    """The damping is multiplied by this after a step that is undone. [by hand]"""
    min_damping: float = 1e-9
    """Added to the diagonal, whatever it is. [derived: far below every entry; keeps the matrix invertible]"""
    relative_damping: float = 1e-6
    """The same as a share of the largest entry. [derived: about the precision of float32 Jacobians]"""
    fixed_damping: float = 1e9
    """Added to the diagonal entries of unknowns that are not to move. [derived: far above every entry]"""
    max_step: float = 0.6
    """Radians, working units and log scale: largest entry of a step. [by hand]"""
    spread_quantile: float = 0.3
    """Quantile of |residuals| that tells their spread. So low, because for up to two thirds of the samples the other
    field may have no surface. [derived]"""
    spread_factor: float = 6.7
    """Kernel width over this quantile: 30 % of normal residuals are below 0.385 standard deviations, so 6.7 times that
    is 2.6 standard deviations. [derived; the 2.6 by hand]"""
    unobserved_width: float = 0.3
    """Share of the kernel width of object samples at unobserved places: the surface nearest to them is the border of
    what was observed, and would draw them there. [by hand, on objects known from one view]"""
    unobserved_loss: float = 0.6
    """Score, 0..1. Largest loss of an object sample at an unobserved place. [by hand, on objects known from one
    view]"""
    min_observed_share: float = 0.25
    """Share of the object's samples. Where fewer are observed, they weigh no more than if so many were. [by hand]"""
    max_offset: float = 0.04
    """Diameters. Largest offset between the two surfaces. [early fits]"""
    offset_prior: float = 0.02
    """Weight of "no offset", where one direction's samples weigh 1: round things may be larger as well as thicker.
    [early fits]"""
    offset_prior_partial: float = 0.3
    """The same where part of the scene was not observed: all that was seen from one side may be larger as well as
    thicker. [random worlds]"""


REFINEMENT = RefinementConstants()
