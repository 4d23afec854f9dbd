"""The evidence on held-out samples, the verdict, and how poses differ, in words.

The package's docstring explains the sources.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EvidenceConstants:
    """What held-out samples tell of a pose (verdict/evidence.py, verdict/unexplained_surface.py)."""

    score_width: float = 0.015
    """Diameters. Kernel width of the score. [main pairs]"""
    near: float = 0.1
    """Diameters from the object's surface. Scene samples farther off belong to something else. [main pairs]"""
    min_inlier_cosine: float = 0.5
    """Cosine between the normals of an inlier: 60 degrees. [main pairs]"""
    coarse_distance: float = 2.0
    """Inlier distances. Largest residual of coarse agreement. [early fits]"""
    tail_quantiles: tuple[float, float] = (0.3, 0.75)
    """Quantiles of |residuals|; the tail ratio is the second over the first. [early fits]"""
    close: float = 0.02
    """Diameters. Residuals of close agreement; object samples farther out stand in free space that was seen. [derived:
    less than half of the 5 % by which a pose may be off]"""
    agreement: float = 0.03
    """Diameters. Samples with smaller residuals may belong to the same surface; others do not. [derived: as above]"""
    coarse: float = 0.04
    """Diameters. Residuals of coarse agreement. [derived: as above]"""
    hull_margin: float = 0.01
    """Diameters. What lies so far within the object's hull touches it from inside. [by hand]"""
    min_core: float = 0.002
    """Diameters. Smallest core of residuals that the tail is compared with: exact fields have a core of 0. [by hand]"""
    min_confirmed_in_patch: float = 0.3
    """Share of a patch's samples that are confirmed where the patch counts as confirmed. [by hand]"""
    min_samples_in_patch: int = 5
    """Scene samples near a patch that it takes to cover it. [by hand]"""
    min_slope: float = 1e-3
    """Length of the gradient. A shorter one has no direction. [derived]"""
    facing_cosine: float = -0.25
    """Cosine between the normals below which surface faces the object's own: 104 degrees. [early fits]"""


@dataclass(frozen=True)
class VerdictConstants:
    """Of the verdict (verdict/criteria.py, verdict/evaluation.py). What is enough is an option."""

    unexplained: float = 0.05
    """Share of unexplained surface near the object without noise, where it is known what was seen: what was measured is
    there. [early fits]"""
    unexplained_per_noise: float = 20.0
    """Shares for each diameter of noise (root mean square of the inliers' residuals), in addition: where a map is
    noisy, what lies on the object cannot be told from a part of another one. [random worlds]"""
    mostly_hidden: float = 0.5
    """Share of the object's samples. Where nothing says what was seen and more is hidden at the best pose, the field
    itself says what was hidden, and the verdict is that of scenes of which it is known. Of the 282 right poses that
    the other model is trained on 2 have more; of one depth image they have .6 to .9. [random worlds; one depth
    image]"""
    max_hidden: float = 0.95
    """Share of the object's samples that may be hidden, wherever they lie: of 696 right poses of scenes of which it is
    known none has more than .935, so the probability knows nothing of poses beyond. [random worlds]"""
    doubtful: float = 0.95
    """Probability below which a further attempt at the search is made, even where the pose is accepted: it may find a
    better pose, or one as good that makes this less likely. Of 113 poses of .8 to .95, 95 instead of 90 are right after
    it, and 11 instead of 17 answers are wrong. [random worlds]"""
    apart: float = 0.05
    """Diameters. Poses farther apart cannot both be right. [derived: right is within 5 % of the truth]"""
    axis_turns: int = 72
    """Turns about a symmetry axis that poses are compared under: half a step moves a point by 2 % of the diameter.
    [derived]"""
    most_lead: float = 6.0
    """Log odds. Larger leads are not told apart. [by hand]"""
    log_odds_per_score: float = 30.0
    """Log odds that a difference of 1 in the score counts as when candidates are compared: odds of poses that fit alike
    differ by chance. At 20, 30 and 50 the choice is right in 333, 332 and 328 of 356 cases that have a right pose, at 0
    in 319. [random worlds]"""
    rivals_min_distance: float = 0.1
    """Diameters. Poses closer together are one answer with its uncertainty. [by hand]"""
    min_same_surface: float = 0.8
    """Share of the object's samples that come to lie on its own surface when it is moved from one pose to another.
    Poses that agree in so many place nearly the same surface. [random worlds; wrong objects on clean fields]"""
    rival_log_odds: float = 3.0
    """Log odds. A pose that is less likely than the best one by more, a factor of 20, is told apart from it, however
    near its score. [by hand]"""
    rival_margin_per_score: float = 0.15
    """Share of the best score added to the option ``rival_margin``: the worse the fields agree, the less a difference
    of scores tells. [main pairs]"""


@dataclass(frozen=True)
class RelationConstants:
    """How two poses differ, in words (verdict/relation.py)."""

    axis_angle_deg: float = 6.0
    """Degrees between a rotation's axis and a coordinate axis that it is named by. [by hand]"""
    min_angle_deg: float = 2.0
    """Degrees. Smaller rotations are not named. [by hand]"""
    min_scale_change: float = 0.03
    """Share. Smaller changes of scale are not named. [by hand]"""


EVIDENCE = EvidenceConstants()
VERDICT = VerdictConstants()
RELATION = RelationConstants()
