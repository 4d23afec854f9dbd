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


# The pose's covariance.
#
# The package's docstring explains the sources.


@dataclass(frozen=True)
class CovarianceConstants:
    """The pose's covariance (verdict/covariance.py). Checked by benchmarks/results/robust/covariance.md."""

    lengths: tuple[float, ...] = (0.02, 0.03, 0.045, 0.07, 0.1, 0.15, 0.21, 0.3, 0.42, 0.6)
    """Diameters. Correlation lengths that are compared: from the spacing of the samples to half of the object, in steps
    of about 1.5. [derived]"""
    nuggets: tuple[float, ...] = (0.0003, 0.002, 0.01, 0.05, 0.2, 0.7)
    """Shares of the variance without correlation that are compared, in steps of about 5. [derived]"""
    likelihood_samples: int = 160
    """Samples on which lengths and nuggets are compared: the cost grows with their third power. [by hand]"""
    propagated_samples: int = 900
    """Samples through which errors act on the pose: smooth errors almost cancel in some directions, which few samples
    would not show. [by hand]"""
    min_weight: float = 0.3
    """Kernel weight of an inlier. Samples with less belong to something else. [by hand]"""
    regularization: float = 1e-6
    """Relative. Keeps matrices positive definite. [derived: far above float64's precision, far below every nugget]"""
    normals_length: float = 0.6
    """Distance of unit normals, about 35 degrees: how far surfaces may be turned from one another and still be off
    alike. The likelihood of the residuals has its maximum at .35 to .6. [random worlds]"""
    residuals_factor: float = 3.8
    """Of the covariance that the residuals tell. [random worlds, benchmarks/notes/covariance.md]"""
    offset_factor: float = 2.3
    """Of the offset between the surfaces, as an error of the pose. [random worlds, the same]"""
    min_variance: float = 1e-18
    """Square diameters. Smallest variance of the errors. [derived: exact fields have residuals of 0]"""


COVARIANCE = CovarianceConstants()


# Samples of both surfaces.
#
# The package's docstring explains the sources.


@dataclass(frozen=True)
class SamplingConstants:
    """Samples of both surfaces (sampling.py)."""

    box_growth: float = 1.2
    """Factor. The scene is sampled in the detection box grown by this: boxes are often too small or off center. [by
    hand]"""
    object_base: int = 8
    """Cells along the longest edge of the object's first grid. [by hand]"""
    scene_base: int = 9
    """The same for the scene. [by hand]"""
    levels: int = 2
    """How often a cell near the surface is divided by two along each axis. [by hand]"""
    max_cell_distance: float = 0.6
    """Cell edges from the surface. Cells farther off find the same points as their neighbors. [by hand]"""
    max_sample_distance: float = 0.35
    """Cell edges from the surface. A sample that is farther off after its Newton step is dropped. [by hand]"""
    min_slope: float = 0.2
    """Length of the gradient. A Newton step along a shorter one leads nowhere: true distances have 1. [by hand]"""
    cloud_margin: float = 0.05
    """Share of the box's size. Points of a result's clouds may lie so far outside of the box. [by hand]"""


SAMPLING = SamplingConstants()


# What a detection shows of a scene: smoothing, support planes, occlusion.
#
# The package's docstring explains the sources.


@dataclass(frozen=True)
class SceneConstants:
    """What a detection shows of a scene (scene/scene_view.py, scene/smoothing.py)."""

    min_foreground: int = 30
    """Samples in front of the support planes. With fewer, the support planes are kept. [by hand]"""
    smooth_normal_roughness: float = 0.012
    """Normal roughness. Up to here a field counts as smooth and has no surface offset: a box would else pass for a
    larger one. Accurate fits have about 0.01. [early fits]"""
    offset_per_normal_roughness: float = 2.0
    """Diameters of allowed surface offset for normal roughness beyond ``smooth_normal_roughness``. [early fits]"""
    neighbors: int = 16
    """Nearest samples over which normals and heights are averaged. [by hand]"""
    averaging_rounds: int = 2
    """How often normals are averaged. After the first round the roughest normals still pull. [by hand]"""
    min_same_sheet_cosine: float = 0.3
    """Cosine between the normals of neighbors on the same side of a thin part. [by hand]"""


@dataclass(frozen=True)
class SupportPlaneConstants:
    """Floors, walls and table tops (scene/support_planes.py). The rough values: [early fits]."""

    max_planes: int = 3
    """Planes that are removed one after the other: a floor and two walls. [by hand]"""
    candidates: int = 200
    """Samples through which planes are tried. [by hand]"""
    min_points: int = 10
    """Samples that a plane is fitted to, and that have to be left for another plane. [by hand]"""
    thickness: float = 0.012
    """Diagonals. Half the thickness of a plane in an accurate field. [by hand]"""
    thickness_per_roughness: float = 2.5
    """Multiples of the surface's roughness: the same in a rough field. [early fits]"""
    max_thickness: float = 0.03
    """Diagonals. No plane is thicker. [early fits]"""
    max_share_of_height: float = 0.125
    """Share of the detection box's height above the plane. No plane is thicker: what lies flat on it would be removed
    with it. [by hand, on random worlds]"""
    min_normal_cosine: float = 0.9
    """Cosine between a plane's normal and those of its points: 26 degrees. [by hand]"""
    fit_rounds: int = 2
    """How often a plane is fitted to the samples near it: in rough fields, and where only samples outside of the
    detection box count. [early fits]"""
    fit_thickness: float = 2.5
    """Multiples of the plane's thickness: samples that it is fitted to. [early fits]"""
    fit_min_normal_cosine: float = 0.8
    """Cosine between its normal and theirs: 37 degrees. [early fits]"""
    min_share: float = 0.06
    """Share of all samples on a plane that is worth removing. [by hand]"""
    behind: float = 2.0
    """Thicknesses. Samples farther behind a plane stand behind it. [by hand]"""
    max_share_behind: float = 0.04
    """Share of all samples behind a support plane. An object's own face has the rest of the object behind it. [by
    hand]"""
    rough_range: tuple[float, float] = (0.02, 0.06)
    """Normal roughness of accurate fits, and of fits stopped after 3 % of their training: from one to the other the
    rough values apply more and more. [early fits]"""
    broad_share: float = 0.15
    """Share of all samples. Only planes with more of them may have loose surface behind them. [early fits]"""
    max_share_behind_rough: float = 0.7
    """Share of a broad plane's samples that may stand behind it in the roughest fields. [early fits]"""
    far_side_cosines: tuple[float, float] = (-0.9, -0.5)
    """Cosine to the plane's normal below which a sample is the far side of a floor: accurate and rough. [early fits]"""
    min_share_outside: float = 0.15
    """Share of a plane's samples outside of the detection box: a floor goes on there. Only for scenes with an
    observation. [early fits]"""
    removed_thickness: float = 1.5
    """Thicknesses above a plane up to which samples are removed with it. [by hand]"""
    removed_min_cosine: float = 0.5
    """Cosine between its normal and theirs: 60 degrees. [by hand]"""


@dataclass(frozen=True)
class OcclusionConstants:
    """What the cameras cannot have seen: where an observation says so (working_frame.py), and the occlusion boundaries
    of a scene seen from one point (scene/occlusion_boundary.py)."""

    clearance_quantile: float = 0.9
    """Of the distances from voxels with a measured surface to the nearest free one. The surface lies within a layer of
    such voxels, and those at its back are the farthest. [by hand; .75 is too little for fits to a recorded kitchen]"""
    min_clearance: float = 2.0
    """Voxels. One of the places at half of the clearance and at all of it in front of a surface element was seen to be
    free, or nobody saw the element from its front. [derived: the first lies beyond the surface's own voxel; next to a
    measured surface, a voxel may count as unobserved although it was seen. Compared with one and three voxels on random
    worlds]"""
    max_clearance: float = 8.0
    """Voxels. [by hand]"""
    voxels_drawn: int = 1 << 17
    """Voxels of an observation, drawn at random, among which those with a measured surface are taken. [by hand]"""
    voxels_asked: int = 1000
    """Of those, at most so many. [by hand]"""

    guesses: int = 3000
    """Viewpoints tried: where the tangent planes of three random samples meet. [by hand]"""
    points: int = 500
    """Samples that each guess is checked on. [by hand]"""
    min_volume: float = 0.05
    """Volume spanned by three unit normals. Planes that are closer to parallel meet anywhere. [by hand]"""
    max_distance: float = 30.0
    """Diagonals from the box's center to a viewpoint. [by hand]"""
    edge_on_cosine: float = 0.05
    """Cosine between normal and line of sight below which a surface is seen edge-on: 3 degrees. [by hand]"""
    boundary_cosine: float = 0.10
    """The same for the final decision, from the refined viewpoint: 6 degrees. [by hand]"""
    facing_away_cosine: float = -0.15
    """A smaller cosine is a surface that faces away from the viewpoint. [by hand]"""
    max_facing_away: float = 0.04
    """Share of the samples that may face away. [by hand]"""
    min_edge_on: float = 0.15
    """Share of the samples that are edge-on. With fewer the scene has no occlusion boundary that matters. [by hand]"""
    refinements: int = 3
    """Least squares steps from the best guess. [by hand]"""


SCENE = SceneConstants()
SUPPORT_PLANES = SupportPlaneConstants()
OCCLUSION = OcclusionConstants()
