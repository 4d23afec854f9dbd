"""Every tuned number of the preset `robust`: its unit, its meaning, and where it comes from.

The source stands in brackets at the end of each entry:

- [derived]: follows from the reason that is given.
- [published]: from the publication that is named.
- [main pairs]: chosen on the eleven main pairs of the benchmark (benchmarks/robust); its held-out pairs are the check.
- [early fits]: introduced for fits to images that were stopped early or show unseen parts (benchmarks/images). Chosen
  by hand there; how the results depend on the value was not recorded.
- [library]: measured on the library of 64 objects of the benchmark (benchmarks/results/robust/library.md).
- [random worlds]: chosen on the parts train and validation of random worlds, each world left out in its turn
  (docs/verdict.md).
- [by hand]: chosen by hand; no tuning and no comparison with other values is recorded.

"Diameters" are diameters of the library object, the length unit of the object's working frame. "Diagonals" are
diagonals of the detection box, the length unit of the scene's working frame. What a user may want to change is an
option, see regnf_core/options.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from regnf_core.robust.stage import Stage


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

    front_voxels: tuple[float, float] = (1.0, 2.0)
    """Voxels of the observation in front of a surface element. One of both places was seen to be free, or nobody saw
    the element from its front. [derived: the first lies beyond the surface's own voxel; next to a measured surface, a
    voxel may count as unobserved although it was seen. Compared with one and three voxels on random worlds]"""

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


_SEARCH_HEAD = (
    Stage(points=48, widths=(), score_width=0.10, keep=500),
    Stage(64, (0.15, 0.12, 0.10, 0.08), score_width=0.06, keep=120, min_distance=0.05, keeps_scale=True),
)
_SEARCH_CLOSER = Stage(points=128, widths=(0.08, 0.06, 0.05, 0.04), score_width=0.04, keep=60, min_distance=0.05)
_SEARCH_END = (
    Stage(points=256, widths=(0.04, 0.03, 0.03, 0.03), score_width=0.03, keep=20, min_distance=0.05),
    Stage(
        points=200,
        widths=(0.06, 0.05, 0.04, 0.03, 0.03),
        score_width=0.03,
        keep=12,
        min_distance=0.03,
        copies=12,
        spread=(0.10, 0.035, 0.05),
    ),
)


@dataclass(frozen=True)
class SearchConstants:
    """Pose candidates from samples alone (search/)."""

    scale_factors: tuple[float, ...] = (0.85, 1.0, 1.18)
    """Factors about the ratio of the radii: clutter and missing parts change it. About equal steps. [by hand]"""
    rotations_per_turn: int = 10
    """Rotations of the full search for each turn about a given up axis. [by hand]"""
    min_rotations: int = 24
    """Rotations or turns that a search starts from at least. [by hand]"""
    warm_start_copies: int = 63
    """Perturbed copies of a given initial pose. [by hand]"""
    warm_start_spread: tuple[float, float, float] = (0.17, 0.05, 0.10)
    """Standard deviations of their rotation (radians), translation (diameters) and log scale. [by hand]"""
    stages: tuple[Stage, ...] = (*_SEARCH_HEAD, _SEARCH_CLOSER, *_SEARCH_END)
    """Successive halving on distance grids. The first stage only ranks the seeds. The second one, with the widest
    kernels, keeps their scales: among clutter an object that grows comes nearer to all of it. The last one leaves
    local minima: thin parts and what is close by hold poses some hundredths of the diameter off. [by hand, the second
    and the last one on random worlds, docs/worlds.md]"""
    thorough_stages: tuple[Stage, ...] = (
        *_SEARCH_HEAD,
        replace(_SEARCH_CLOSER, copies=6, spread=(0.40, 0.08, 0.15)),
        replace(_SEARCH_CLOSER, copies=6, spread=(0.40, 0.08, 0.15)),
        replace(_SEARCH_CLOSER, copies=6, spread=(0.15, 0.05, 0.07)),
        *_SEARCH_END,
    )
    """The same where the first search ended in a rejection: many truths have a better score than all that it found,
    but no seed in their basin. Copies moved as far as seeds lie from one another reach it. [by hand, on random
    worlds]"""
    min_share_of_detection: float = 0.25
    """Share of the detection box's edge. Along one of them at least, the object is that long. [by hand]"""
    box_weight: float = 0.2
    """Score, 0..1. So much worse is a pose that ends at none of the box's faces. [by hand, on random worlds]"""
    box_width: float = 0.25
    """Share of the box's edge. Kernel width of the distance between the object's end and the box's face.
    [by hand, on random worlds]"""
    min_face_distance: float = 0.2
    """Diagonals. Shorter edges of a box count as this long: what is flat lies in a box that is not.
    [by hand]"""
    seed_tolerance: float = 2.0
    """Seeds may reach beyond the detection this many times as far as poses: their scale and place are rough. [by
    hand]"""
    batch: int = 512
    """Poses at once: bounds memory, and what is in use stays in the processor's cache. [by hand]"""
    grid_cells: int = 40
    """Cells along each edge of a distance grid. [by hand]"""
    grid_margin: float = 0.2
    """Working units around the samples that a distance grid covers. [by hand]"""
    tangent_spacings: float = 2.0
    """Sample spacings. Closer than this the tangent plane is the better distance. [by hand]"""


@dataclass(frozen=True)
class FeatureConstants:
    """Seeds from FPFH features and RANSAC (search/features.py). Clouds have a root mean square radius of one."""

    voxel: float = 0.08
    """Root mean square radii. Edge of the voxels of the downsampling. [by hand]"""
    feature_radius: float = 4.0
    """Voxels. Radius of a feature's neighborhood; open3d's tutorial uses 5. [by hand]"""
    inlier_distance: float = 1.5
    """Voxels. Largest distance of a RANSAC inlier. [published: open3d's tutorial of global registration]"""
    iterations: int = 20_000
    """Of RANSAC. [by hand]"""
    min_points: int = 30
    """Points of a cloud that is described. [by hand]"""
    scales: tuple[float, float] = (0.2, 5.0)
    """Scale between the two clouds beyond which a match is wrong. [by hand]"""


_LAST_STAGES = (
    Stage(
        points=700,
        widths=(0.01, 0.01) + (0.008,) * 5,
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
    narrow ones keep what is close by from drawing it away. Normals do not count: the cost is smooth without them, and
    so many iterations bring poses of other seeds to the same place before the second. [by hand, the second on random
    worlds]"""
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
    max_offset: float = 0.04
    """Diameters. Largest offset between the two surfaces. [early fits]"""
    offset_prior: float = 0.02
    """Weight of "no offset", where one direction's samples weigh 1: round things may be larger as well as thicker.
    [early fits]"""
    offset_prior_partial: float = 0.3
    """The same where part of the scene was not observed: all that was seen from one side may be larger as well as
    thicker. [random worlds]"""


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
    min_slope: float = 1e-3
    """Length of the gradient. A shorter one has no direction. [derived]"""
    facing_cosine: float = -0.25
    """Cosine between the normals below which surface faces the object's own: 104 degrees. [early fits]"""


@dataclass(frozen=True)
class VerdictConstants:
    """Thresholds of the verdict (verdict/criteria.py, verdict/evaluation.py).

    "Noise" is the root mean square of the inliers' residuals, diameters. Limits that depend on it: where the inliers
    agree to a thousandth of the diameter, a tenth of the surface that does not agree is another thing (a chair without
    its cushion); where they agree to a hundredth, it may be the fields' errors.
    """

    clean_violations: float = 0.05
    """Share of object samples in free space that a field without noise may have. [main pairs]"""
    violations_per_noise: float = 20.0
    """Shares for each diameter of noise, in addition. [main pairs]"""
    clean_inlier_share: float = 0.89
    """Share of the scene samples near the object that agree in a field without noise. [main pairs]"""
    inlier_share_per_noise: float = 45.0
    """Shares for each diameter of noise, less. [main pairs]"""
    unexplained: float = 0.03
    """Share of unexplained surface near the object without noise. [early fits]"""
    unexplained_observed: float = 0.05
    """The same for scenes with an observation: what was measured is there. [early fits]"""
    unexplained_per_noise: float = 20.0
    """Shares for each diameter of noise, in addition: fits to images invent surface that nobody saw, and where a map is
    noisy, what lies on the object cannot be told from a part of another one. [early fits; random worlds]"""
    rough: float = 0.022
    """Normal roughness from which a field counts as rough. [early fits]"""
    rough_score: float = 0.5
    """Largest score of a rough field at that roughness. [early fits]"""
    score_per_normal_roughness: float = 12.0
    """Score for each unit of normal roughness beyond, in addition. [early fits]"""
    max_tail_ratio: float = 5.5
    """Tail ratio: 3 for normal errors that are alike everywhere. Another object's residuals are small where it is alike
    and large elsewhere. [early fits]"""
    min_coarse: float = 0.68
    """Coarse agreement of a rough field. [early fits]"""
    min_coarse_partial: float = 0.72
    """The same where part of the scene is known not to have been observed. [early fits]"""
    min_coarse_observed: float = 0.78
    """The same for smooth fields of such scenes. [early fits]"""
    max_occluded: float = 0.6
    """Share of occluded object samples with which coarse agreement is enough. [early fits]"""
    max_offset: float = 0.015
    """Diameters. Surface offset with which coarse agreement is enough in a smooth field. [early fits]"""
    min_probability: float = 0.7
    """Probability of being right that a pose needs even where it meets all criteria. [random worlds: worlds left out of
    the parts train and validation, docs/verdict.md]"""
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
    min_variance: float = 1e-18
    """Square diameters. Smallest variance of the errors. [derived: exact fields have residuals of 0]"""


@dataclass(frozen=True)
class LibraryConstants:
    """Search of a library (library_search.py)."""

    shortlist: int = 12
    """Objects that are searched coarsely. With 64 objects the right one was never below place 7. [library]"""
    max_refined: int = 4
    """Objects that are refined on their fields: the time of a search is bounded by this. [by hand]"""
    margin: float = 0.15
    """Coarse score. Objects farther behind the best one are not refined. [by hand]"""
    rotations_divisor: float = 2.5
    """Rotations of a registration for each one of the coarse search. [by hand]"""
    stages: tuple[Stage, ...] = (
        Stage(points=48, widths=(), score_width=0.10, keep=120),
        Stage(points=64, widths=(0.15, 0.12, 0.10, 0.08), score_width=0.06, keep=30, min_distance=0.05),
        Stage(points=128, widths=(0.08, 0.06, 0.05, 0.04), score_width=0.04, keep=8, min_distance=0.05),
    )
    """The coarse search: the first stages of a registration with a quarter of the poses. [by hand]"""


SAMPLING = SamplingConstants()
MODEL = ModelConstants()
SIGNATURE = SignatureConstants()
SCENE = SceneConstants()
SUPPORT_PLANES = SupportPlaneConstants()
OCCLUSION = OcclusionConstants()
SEARCH = SearchConstants()
FEATURES = FeatureConstants()
REFINEMENT = RefinementConstants()
EVIDENCE = EvidenceConstants()
VERDICT = VerdictConstants()
RELATION = RelationConstants()
COVARIANCE = CovarianceConstants()
LIBRARY = LibraryConstants()
