"""An object's model: extremal points, symmetries, signature.

The package's docstring explains the sources.
"""

from __future__ import annotations

from dataclasses import dataclass

from regnf_core.robust.stage import Stage


@dataclass(frozen=True)
class ModelConstants:
    """An object's model: extremal points and symmetries (model/)."""

    extremal_points: int = 16
    """Outermost points by which two placements of the object are compared. [by hand]"""
    rotations: int = 600
    """Rotations tried for symmetries: as many as the option ``rotations``. [by hand]"""
    points: int = 200
    """Samples on which symmetries are proposed. [by hand]"""
    stages: tuple[Stage, ...] = (
        Stage(points=48, widths=(), score_width=0.1, keep=80),
        Stage(points=200, widths=(0.1, 0.07, 0.05, 0.03, 0.02, 0.02), score_width=0.02, keep=80),
    )
    """Coarse to fine registration of the object with itself. [by hand]"""
    max_score_above_identity: float = 0.35
    """Score, 0..1. A rotation may be a symmetry up to this above the identity's score: the field decides. [by hand]"""
    max_symmetries: int = 12
    """Proposals that the field has to confirm, about 4,000 evaluations each. [by hand]"""
    min_distance: float = 0.08
    """Diameters between two different symmetries. [by hand]"""
    axis_turns: int = 36
    """Turns about an axis that all have to be symmetries before it counts as continuous: every 10 degrees. [by hand]"""
    axis_representatives: int = 8
    """Equal turns that stand for a continuous axis among the symmetries. [by hand]"""
    axis_angles: tuple[float, float] = (0.1, 3.0)
    """Radians. Only symmetries with such an angle propose a continuous axis: what is round has others than half turns,
    and the axis of a small turn is inaccurate. [derived]"""
    min_axis_cosine: float = 0.97
    """Cosine between an axis and the rotation vectors that count as turns about it: 14 degrees. [by hand]"""
    min_parallel_cosine: float = 0.99
    """Cosine between the axes of an object's symmetries, if it has one axis: 8 degrees. [by hand]"""
    confirming_points: int = 300
    """Samples on which the field confirms symmetries. [by hand]"""
    confirming_widths: tuple[float, ...] = (0.03, 0.02, 0.015, 0.01, 0.01, 0.01)
    """Diameters. Kernel widths of the confirmation. [by hand]"""
    max_deviation: float = 0.01
    """Diameters. A sample that is carried farther off the surface deviates. Normals do not count: at the edges of thin
    boards a fitted field has arbitrary ones. [by hand]"""
    max_deviating_share: float = 0.03
    """Share of deviating samples of a rotation that is reported as a symmetry. [by hand]"""


@dataclass(frozen=True)
class SignatureConstants:
    """A shape's signature (model/signature.py). A changed value makes stored object models invalid."""

    pairs: int = 20_000
    """Point pairs that are drawn. [by hand]"""
    max_distance: float = 2.5
    """Root mean square distances. The histograms end here; longer pairs count in the last bin. [by hand]"""
    distance_bins: int = 40
    """Bins of the distribution of distances. [by hand]"""
    feature_distance_bins: int = 10
    """Bins of the distance of a point pair feature. [by hand]"""
    angle_bins: int = 3
    """Bins of each of its three angles. [by hand]"""


MODEL = ModelConstants()
SIGNATURE = SignatureConstants()
