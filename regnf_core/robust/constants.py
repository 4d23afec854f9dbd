"""Every tuned number of the preset `robust`: its unit, its meaning, and where it comes from.

The source stands in brackets at the end of each comment, which is beside the number or above it:

- [derived]: follows from the reason that is given.
- [published]: from the publication that is named.
- [main pairs]: chosen on the eleven main pairs of the benchmark (benchmarks/robust); its held-out pairs are the check.
- [early fits]: introduced for fits to images that were stopped early or show unseen parts (benchmarks/images). Chosen
  by hand there; how the results depend on the value was not recorded.
- [library]: measured on the library of 64 objects of the benchmark (benchmarks/results/robust/library.md).
- [random worlds]: chosen on the parts train and validation of random worlds, each world left out in its turn
  (docs/verdict.md).
- [by hand]: chosen by hand; no tuning and no comparison with other values is recorded.

"Diameters" are of the library object, the length unit of the object's working frame. "Diagonals" are of the detection
box, the length unit of the scene's working frame. What a user may want to change is an option: regnf_core/options.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Stage:
    """One stage of a coarse-to-fine refinement: refine all poses on ``points`` samples of each surface, keep the best.

    widths: kernel widths, one iteration each, object diameters; without any, poses are only scored · score_width:
    kernel width of the score · keep: at most so many poses · min_distance: between two kept poses, object diameters ·
    margin: kept poses score no worse than the best one plus this · widest: where the residuals' spread asks for it,
    kernels are wider than ``widths``, up to this, see :func:`regnf_core.robust.refine.loss.adaptive_width`; 0: they are
    not · keeps_scale: no pose's scale changes · normals: whether the loss that is minimized counts them · copies: of
    each pose that are refined with it, moved at random · spread: standard deviations of their rotation (radians),
    translation (diameters) and log scale.
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


@dataclass(frozen=True)
class ModelConstants:
    """An object's model: extremal points and symmetries (model.py)."""

    extremal_points: int = 16  # outermost points by which two placements of the object are compared [by hand]
    rotations: int = 600  # rotations tried for symmetries: as many as the option `rotations` [by hand]
    points: int = 200  # samples on which symmetries are proposed [by hand]
    # Coarse to fine registration of the object with itself. [by hand]
    stages: tuple[Stage, ...] = (
        Stage(points=48, widths=(), score_width=0.1, keep=80),
        Stage(points=200, widths=(0.1, 0.07, 0.05, 0.03, 0.02, 0.02), score_width=0.02, keep=80),
    )
    # Score, 0..1: a rotation may be a symmetry up to this above the identity's score; the field decides. [by hand]
    max_score_above_identity: float = 0.35
    max_symmetries: int = 12  # proposals that the field has to confirm, about 4,000 evaluations each [by hand]
    min_distance: float = 0.08  # diameters between two different symmetries [by hand]
    axis_turns: int = 36  # turns about an axis, all symmetries if it is continuous: every 10 degrees [by hand]
    axis_representatives: int = 8  # equal turns that stand for a continuous axis among the symmetries [by hand]
    # Radians: symmetries by such an angle propose a continuous axis. What is round has others than half turns, and the
    # axis of a small turn is inaccurate. [derived]
    axis_angles: tuple[float, float] = (0.1, 3.0)
    min_axis_cosine: float = 0.97  # between an axis and rotation vectors that are turns about it: 14 degrees [by hand]
    min_parallel_cosine: float = 0.99  # between the axes of symmetries of an object with one axis: 8 degrees [by hand]
    confirming_points: int = 300  # samples on which the field confirms symmetries [by hand]
    confirming_widths: tuple[float, ...] = (0.03, 0.02, 0.015, 0.01, 0.01, 0.01)  # diameters, of kernels [by hand]
    # Diameters: a sample that is carried farther off the surface deviates. Normals do not count: at the edges of thin
    # boards a fitted field has arbitrary ones. [by hand]
    max_deviation: float = 0.01
    max_deviating_share: float = 0.03  # of the samples, of a rotation that is reported as a symmetry [by hand]


@dataclass(frozen=True)
class SignatureConstants:
    """A shape's signature (model.py). A changed value makes stored object models invalid."""

    pairs: int = 20_000  # point pairs that are drawn [by hand]
    max_distance: float = 2.5  # root mean square distances: longer pairs count in the histograms' last bin [by hand]
    distance_bins: int = 40  # of the distribution of distances [by hand]
    feature_distance_bins: int = 10  # of the distance of a point pair feature [by hand]
    angle_bins: int = 3  # of each of its three angles [by hand]


@dataclass(frozen=True)
class LibraryConstants:
    """Search of a library (regnf_core/library.py)."""

    shortlist: int = 12  # objects searched coarsely; with 64, the right one was never below place 7 [library]
    max_refined: int = 4  # objects refined on their fields: bounds the time of a search [by hand]
    margin: float = 0.15  # coarse score: objects farther behind the best one are not refined [by hand]
    rotations_divisor: float = 2.5  # rotations of a registration for each one of the coarse search [by hand]
    # The coarse search: the first stages of a registration with a quarter of the poses. [by hand]
    stages: tuple[Stage, ...] = (
        Stage(points=48, widths=(), score_width=0.10, keep=120),
        Stage(points=64, widths=(0.15, 0.12, 0.10, 0.08), score_width=0.06, keep=30, min_distance=0.05),
        Stage(points=128, widths=(0.08, 0.06, 0.05, 0.04), score_width=0.04, keep=8, min_distance=0.05),
    )


_LAST_STAGE = Stage(
    700, (0.015, 0.01, 0.01, 0.008, 0.008), 0.015, keep=8, min_distance=0.03, margin=1.0, widest=0.02, normals=False
)


@dataclass(frozen=True)
class RefinementConstants:
    """Levenberg-Marquardt on the fields (refine/)."""

    # On all pose candidates. The first stage was chosen together with the last one of the search, which uses the wider
    # kernels. [by hand, the first and the numbers kept on random worlds]
    stages: tuple[Stage, ...] = (
        Stage(200, (0.05, 0.04, 0.03, 0.02, 0.02), 0.02, keep=10, min_distance=0.03, margin=0.15, widest=0.04),
        Stage(300, (0.02, 0.015, 0.01, 0.01), 0.015, keep=6, min_distance=0.03, margin=0.10, widest=0.04),
    )
    # On what is left, and the best pose's symmetry equivalents. Wide kernels find the pose among rough surfaces, narrow
    # ones keep what is close by from drawing it away. Normals do not count: the cost is smooth without them. The first
    # begins with wider kernels: narrow ones have minima close to each other, in which poses of other seeds would end.
    # [by hand, the second on random worlds]
    last_stages: tuple[Stage, ...] = (
        replace(_LAST_STAGE, widths=(0.02, 0.02, 0.015, 0.01) + (0.008,) * 3, widest=0.04),
        _LAST_STAGE,
    )
    same_pose: float = 0.06  # diameters: a symmetry equivalent closer to a pose that is there is not added [by hand]
    damping_start: float = 1e-2  # of the first iteration, relative to the normal equations' diagonal [by hand]
    damping_range: tuple[float, float] = (1e-7, 1e4)  # the damping stays within [by hand]
    damping_decrease: float = 6.0  # divides the damping after a step that lowers the cost [by hand]
    damping_increase: float = 5.0  # multiplies the damping after a step that is undone [by hand]
    min_damping: float = 1e-9  # added to the diagonal: far below every entry, keeps it invertible [derived]
    relative_damping: float = 1e-6  # the same, of the largest entry: the precision of float32 Jacobians [derived]
    fixed_damping: float = 1e9  # added to the diagonal of unknowns that are not to move: above every entry [derived]
    max_step: float = 0.6  # radians, working units and log scale: largest entry of a step [by hand]
    # Quantile of |residuals| that tells their spread. So low, because for up to two thirds of the samples the other
    # field may have no surface. [derived]
    spread_quantile: float = 0.3
    # Kernel width over this quantile: 30 % of normal residuals are below 0.385 standard deviations, so 6.7 times that
    # is 2.6 standard deviations. [derived; the 2.6 by hand]
    spread_factor: float = 6.7
    # Share of the kernel width of object samples at unobserved places: the surface nearest to them is the border of
    # what was observed, and would draw them there. [by hand, on objects known from one view]
    unobserved_width: float = 0.3
    unobserved_loss: float = 0.6  # largest loss of such a sample in the score [by hand, on objects known from one view]
    min_observed_share: float = 0.25  # of the object's samples: fewer observed ones weigh as if so many were [by hand]
    max_offset: float = 0.04  # diameters: largest offset between the two surfaces [early fits]
    # Weight of "no offset", where one direction's samples weigh 1: round objects may be larger as well as thicker.
    # [early fits]
    offset_prior: float = 0.02
    # The same where part of the scene was not observed: all that was seen from one side may be larger as well as
    # thicker. [random worlds]
    offset_prior_partial: float = 0.3


_SEARCH_HEAD = (
    Stage(points=48, widths=(), score_width=0.10, keep=500),
    Stage(64, (0.15, 0.12, 0.10, 0.08), score_width=0.06, keep=120, min_distance=0.05, keeps_scale=True),
)
_SEARCH_CLOSER = Stage(points=128, widths=(0.08, 0.06, 0.05, 0.04), score_width=0.04, keep=60, min_distance=0.05)
_SEARCH_END = (
    Stage(points=256, widths=(0.04, 0.03, 0.03, 0.03), score_width=0.03, keep=20, min_distance=0.05),
    Stage(200, (0.06, 0.05, 0.04, 0.03, 0.03), 0.03, 12, min_distance=0.03, copies=12, spread=(0.10, 0.035, 0.05)),
)


@dataclass(frozen=True)
class SearchConstants:
    """Pose candidates from samples alone (search/)."""

    # Factors about the ratio of the radii: clutter and missing parts change it. About equal steps. [by hand]
    scale_factors: tuple[float, ...] = (0.85, 1.0, 1.18)
    rotations_per_turn: int = 10  # rotations of the full search for each turn about a given up axis [by hand]
    min_rotations: int = 24  # rotations or turns that a search starts from at least [by hand]
    start_copies: int = 63  # perturbed copies of a given initial pose [by hand]
    # Standard deviations of their rotation (radians), translation (diameters) and log scale. [by hand]
    start_spread: tuple[float, float, float] = (0.17, 0.05, 0.10)
    # Successive halving on distance grids. The first stage only ranks the seeds. The second one, with the widest
    # kernels, keeps their scales: among clutter an object that grows comes nearer to all of it. The last one leaves
    # local minima: thin parts and what is close by hold poses some hundredths of the diameter off. [by hand, the second
    # and the last one on random worlds, docs/worlds.md]
    stages: tuple[Stage, ...] = (*_SEARCH_HEAD, _SEARCH_CLOSER, *_SEARCH_END)
    # The same where the first search ended in a rejection: many truths have a better score than all that it found, but
    # no seed in their basin. Copies moved as far as seeds lie from one another reach it. [by hand, on random worlds]
    thorough_stages: tuple[Stage, ...] = (
        *_SEARCH_HEAD,
        *(replace(_SEARCH_CLOSER, copies=6, spread=(0.40, 0.08, 0.15)),) * 2,
        replace(_SEARCH_CLOSER, copies=6, spread=(0.15, 0.05, 0.07)),
        *_SEARCH_END,
    )
    # Cosine between the vertical axes of scene and object, where the option `up_axis` names them: 30 degrees. A map's
    # own vertical is off by less, a toppled thing by more. [by hand]
    min_upright_cosine: float = 0.866
    min_share_of_detection: float = 0.25  # of the box's edge: so long is the object along one of them [by hand]
    # Score, 0..1: so much worse is a pose that ends at none of the box's faces. [by hand, on random worlds]
    box_weight: float = 0.2
    # Share of the box's edge: kernel width of the distance from the object's end to the box's face. [by hand, on random
    # worlds]
    box_width: float = 0.25
    min_face_distance: float = 0.2  # diagonals: shorter edges count as so long; flat objects' boxes are not [by hand]
    facing_cosine: float = -0.2  # of normal and line of sight, below: surface that faces the camera [by hand]
    seed_tolerance: float = 2.0  # so many times as far as poses may seeds, which are rough, leave the box [by hand]
    batch: int = 512  # poses at once: bounds memory, and stays in the processor's cache [by hand]
    grid_cells: int = 40  # along each edge of a distance grid [by hand]
    grid_margin: float = 0.2  # working units around the samples that a distance grid covers [by hand]
    sheet_neighbors: int = 8  # samples among which the other face of a thin wall is looked for [by hand]
    sheet_cosine: float = -0.5  # between the normals of its faces, below [by hand]
    tangent_spacings: float = 2.0  # sample spacings: closer, the tangent plane is the better distance [by hand]


@dataclass(frozen=True)
class FeatureConstants:
    """Seeds from FPFH features and RANSAC (search/distance_grid.py). Clouds have a root mean square radius of one."""

    voxel: float = 0.08  # root mean square radii: edge of the voxels of the downsampling [by hand]
    feature_radius: float = 4.0  # voxels: of a feature's neighborhood; open3d's tutorial uses 5 [by hand]
    # Voxels: largest distance of a RANSAC inlier. [published: open3d's tutorial of global registration]
    inlier_distance: float = 1.5
    iterations: int = 20_000  # of RANSAC [by hand]
    min_points: int = 30  # of a cloud that is described [by hand]
    scales: tuple[float, float] = (0.2, 5.0)  # between the two clouds; a match beyond is wrong [by hand]


@dataclass(frozen=True)
class EvidenceConstants:
    """What held-out samples tell of a pose (verdict/evidence.py)."""

    score_width: float = 0.015  # diameters: kernel width of the score [main pairs]
    near: float = 0.1  # diameters: scene samples farther off the object's surface are something else's [main pairs]
    min_inlier_cosine: float = 0.5  # between the normals of an inlier: 60 degrees [main pairs]
    coarse_distance: float = 2.0  # inlier distances: largest residual of coarse agreement [early fits]
    # Of |residuals|; the tail ratio is the second over the first. [early fits]
    tail_quantiles: tuple[float, float] = (0.3, 0.75)
    # Diameters: residuals of close agreement; object samples farther out stand in free space that was seen. Less than
    # half of the 5 % by which a pose may be off. [derived]
    close: float = 0.02
    agreement: float = 0.03  # diameters: samples with smaller residuals may be of one surface, as above [derived]
    coarse: float = 0.04  # diameters: residuals of coarse agreement, as above [derived]
    hull_margin: float = 0.01  # diameters: so far within the object's hull, surface touches it from inside [by hand]
    min_core: float = 0.002  # diameters: smallest core that the tail is compared with; exact fields have 0 [by hand]
    min_confirmed_in_patch: float = 0.3  # of a patch's samples, where the patch counts as confirmed [by hand]
    min_samples_in_patch: int = 5  # scene samples near a patch that it takes to cover it [by hand]
    # Samples whose mean disagreement is looked at: 1 % of the surface, the least that a part of a similar object has.
    # [derived]
    place_samples: int = 16
    least_in_place: int = 6  # of these that must have been seen [by hand]
    worst_quantile: float = 0.975  # of the means over all places [random worlds]
    unexplained: float = 0.05  # share of the surface near the object that noise does not explain, at least [early fits]
    # Shares for each diameter of noise in addition: where a map is noisy, what lies on the object cannot be told from a
    # part of another one. [random worlds]
    unexplained_per_noise: float = 20.0
    stretch_width: float = 2.0  # of the kernel with which a stretch is fitted, over the noise [by hand]
    usual_stretch: float = 0.05  # strain that is looked for, as a deviation [derived]
    stretch_samples: float = 200.0  # as many errors of the samples are independent [by hand]
    min_slope: float = 1e-3  # of a gradient; a shorter one has no direction [derived]
    facing_cosine: float = -0.25  # between normals; below, surface faces the object's own: 104 degrees [early fits]


@dataclass(frozen=True)
class VerdictConstants:
    """Of the verdict (verdict/answer.py, verdict/evaluation.py). What is enough is an option."""

    # The least probability of an accepted answer, by the level's name. [random worlds]
    default_probability: float = 0.8
    strict_probability: float = 0.95  # the same of the stricter level [random worlds]
    # Shares that nearly all right poses keep say why a probability is low, and decide nothing. Of the object's surface
    # that may be hidden: [random worlds]
    usual_hidden: float = 0.9
    usual_free: float = 0.2  # share of the object's visible surface in free space, at most [main pairs]
    usual_inliers: float = 0.6  # share of inliers in each direction, at least [main pairs]
    usual_unexplained: float = 0.1  # share of the surface near the object that is not the object's, at most [by hand]
    usual_explained: float = 0.4  # share of the surface in the box that the object explains, at least [main pairs]
    # Share of the object's samples. If there is no observation and more is hidden at the best pose, the field
    # itself says what was hidden, and the verdict is that of scenes of which it is known. Of the 282 right poses that
    # the other model is trained on 2 have more; of one depth image they have 0.6 to .9. [random worlds; one depth
    # image]
    mostly_hidden: float = 0.5
    # Share of the surfaces of two candidates that differs and was seen, where they can be told apart: the least part of
    # a similar object is as large. [derived]
    min_deciding: float = 0.01
    most_differing: float = 0.5  # share of both surfaces: candidates that differ by more are not alike [by hand]
    # Share of the observed difference that must support the one more than the other, to decide against
    # their probabilities. [by hand]
    min_favor: float = 0.2
    # Probability below which a further attempt at the search is made, even where the pose is accepted: it may find a
    # better pose, or one as good that makes this less likely. Of 113 poses of 0.8 to 0.95, 95 instead of 90 are right
    # after it, and 11 instead of 17 answers are wrong. [random worlds]
    doubtful: float = 0.95
    apart: float = 0.05  # diameters: poses farther apart cannot both be right, within 5 % of the truth [derived]
    axis_turns: int = 72  # about a symmetry axis, for comparing poses: half a step is 2 % of the diameter [derived]
    most_lead: float = 6.0  # log odds: larger leads are not told apart [by hand]
    # Log odds that a difference of 1 in the score counts as when candidates are compared: odds of poses that fit alike
    # differ by chance. At 20, 30 and 50 the choice is right in 333, 332 and 328 of 356 cases that have a right pose, at
    # 0 in 319. [random worlds]
    log_odds_per_score: float = 30.0
    rivals_min_distance: float = 0.1  # diameters: poses closer together are one answer, uncertain [by hand]
    # Share of the object's samples that come to lie on its own surface when it is moved from one pose to another: poses
    # that agree in so many place nearly the same surface. [random worlds; wrong objects on clean fields]
    min_same_surface: float = 0.8
    # Log odds: a pose less likely than the best one by more, a factor of 20, is told apart from it, however near its
    # score. [by hand]
    rival_log_odds: float = 3.0
    # Share of the best score added to the option `rival_margin`: the worse the fields agree, the less a difference of
    # scores tells. [main pairs]
    rival_margin_per_score: float = 0.15


@dataclass(frozen=True)
class RelationConstants:
    """How two poses differ, in words (verdict/evaluation.py)."""

    axis_angle_deg: float = 6.0  # degrees between a rotation's axis and the coordinate axis that names it [by hand]
    min_angle_deg: float = 2.0  # degrees: smaller rotations are not named [by hand]
    min_scale_change: float = 0.03  # smaller changes of scale are not named [by hand]


@dataclass(frozen=True)
class CovarianceConstants:
    """The pose's covariance (verdict/covariance.py). Checked by benchmarks/results/robust/covariance.md."""

    # Diameters: correlation lengths that are compared, from the spacing of the samples to half of the object, in steps
    # of about 1.5. [derived]
    lengths: tuple[float, ...] = (0.02, 0.03, 0.045, 0.07, 0.1, 0.15, 0.21, 0.3, 0.42, 0.6)
    # Shares of the variance without correlation that are compared, in steps of about 5. [derived]
    nuggets: tuple[float, ...] = (0.0003, 0.002, 0.01, 0.05, 0.2, 0.7)
    likelihood_samples: int = 160  # on which both are compared: the cost grows with the third power [by hand]
    # Samples through which errors act on the pose: smooth errors almost cancel in some directions, which few samples
    # would not show. [by hand]
    propagated_samples: int = 900
    min_weight: float = 0.3  # kernel weight of an inlier; samples with less belong to something else [by hand]
    regularization: float = 1e-6  # relative, keeps matrices positive definite: far below every nugget [derived]
    # Distance of unit normals, about 35 degrees: how far surfaces may be turned from one another and still be off
    # alike. The likelihood of the residuals has its maximum at 0.35 to .6. [random worlds]
    normals_length: float = 0.6
    # Of the covariance that the residuals tell. [random worlds, benchmarks/notes/covariance.md]
    residuals_factor: float = 3.8
    offset_factor: float = 2.3  # of the offset between the surfaces, as an error of the pose [random worlds, the same]
    min_variance: float = 1e-18  # square diameters, of the errors: exact fields have residuals of 0 [derived]


@dataclass(frozen=True)
class SamplingConstants:
    """Samples of both surfaces (working_frame.py)."""

    box_growth: float = 1.2  # of the box in which the scene is sampled: boxes are often too small or off [by hand]
    object_base: int = 8  # cells along the longest edge of the object's first grid [by hand]
    scene_base: int = 9  # the same for the scene [by hand]
    levels: int = 2  # how often a cell near the surface is divided by two along each axis [by hand]
    max_cell_distance: float = 0.6  # cell edges: cells farther off find their neighbors' points [by hand]
    face_neighbors: int = 8  # nearest samples among which one faces as that of a farther cell does [by hand]
    max_sample_distance: float = 0.35  # cell edges: samples farther off after the Newton step are dropped [by hand]
    min_slope: float = 0.2  # of a gradient (true distances: 1); steps along shorter ones lead nowhere [by hand]
    cloud_margin: float = 0.05  # of the box's size: so far outside may points of a result's clouds lie [by hand]


@dataclass(frozen=True)
class SceneConstants:
    """What a detection shows of a scene (scene.py)."""

    # Diagonals: so far in front of samples of an instance that images show is the object asked. The noise of depths is
    # wider than thin walls: their other face would answer. [simulated frames]
    ahead_of_thing: float = 0.02
    # Of the option `scene_samples`: with fewer samples of what stands in the box, cells are halved. A halving makes
    # four of one. [derived]
    enough_foreground: float = 0.125
    thick: float = 2.0  # cell edges: what is thinner needs finer cells too, or its faces share them [derived]
    most_further: int = 2  # halvings at most: cells of a hundredth of the box [by hand]
    min_foreground: int = 30  # samples before the support planes; with fewer, these are kept [by hand]
    # Normal roughness. Up to here a field counts as smooth and has no surface offset: a box would else pass for a
    # larger one. Accurate fits have about 0.01. [early fits]
    smooth_normal_roughness: float = 0.012
    offset_per_normal_roughness: float = 2.0  # diameters of allowed offset for roughness beyond it [early fits]
    neighbors: int = 16  # nearest samples over which normals and heights are averaged [by hand]
    averaging_rounds: int = 2  # of normals: after the first, the roughest normals still pull [by hand]
    min_same_sheet_cosine: float = 0.3  # between normals of neighbors on the same side of a thin part [by hand]


@dataclass(frozen=True)
class SupportPlaneConstants:
    """Floors, walls and table tops (scene.py). The rough values: [early fits]."""

    max_planes: int = 3  # removed one after the other: a floor and two walls [by hand]
    candidates: int = 200  # samples through which planes are tried [by hand]
    min_points: int = 10  # samples that a plane is fitted to, and that have to be left for another plane [by hand]
    thickness: float = 0.012  # diagonals: half the thickness of a plane in an accurate field [by hand]
    thickness_per_roughness: float = 2.5  # the same in a rough field, over the surface's roughness [early fits]
    max_thickness: float = 0.03  # diagonals: no plane is thicker [early fits]
    # Share of the detection box's height above the plane. No plane is thicker: what lies flat on it would be removed
    # with it. [by hand, on random worlds]
    max_share_of_height: float = 0.125
    min_normal_cosine: float = 0.9  # between a plane's normal and those of its points: 26 degrees [by hand]
    # How often a plane is fitted to the samples near it: in rough fields, and where only samples outside of the
    # detection box count. [early fits]
    fit_rounds: int = 2
    fit_thickness: float = 2.5  # thicknesses: samples within are fitted to [early fits]
    fit_min_normal_cosine: float = 0.8  # between its normal and theirs: 37 degrees [early fits]
    min_share: float = 0.06  # of all samples on a plane that is worth removing [by hand]
    behind: float = 2.0  # thicknesses: samples farther behind a plane stand behind it [by hand]
    # Share of all samples behind a support plane. An object's own face has the rest of it behind. [by hand]
    max_share_behind: float = 0.04
    # Normal roughness of accurate fits, and of fits stopped after 3 % of their training: from one to the other the
    # rough values apply more and more. [early fits]
    rough_range: tuple[float, float] = (0.02, 0.06)
    broad_share: float = 0.15  # of all samples: planes with more may have loose surface behind them [early fits]
    max_share_behind_rough: float = 0.7  # of a broad plane's samples, behind it in the roughest fields [early fits]
    # Cosine to the plane's normal below which a sample is the far side of a floor: accurate and rough. [early fits]
    far_side_cosines: tuple[float, float] = (-0.9, -0.5)
    # Share of a plane's samples outside of the detection box: a floor goes on there. Only for scenes with an
    # observation. [early fits]
    min_share_outside: float = 0.15
    removed_thickness: float = 1.5  # thicknesses above a plane up to which samples are removed with it [by hand]
    removed_min_cosine: float = 0.5  # between its normal and theirs: 60 degrees [by hand]


@dataclass(frozen=True)
class OcclusionConstants:
    """What the cameras cannot have seen: where an observation says so (working_frame.py), and the occlusion boundaries
    of a scene seen from one point (scene.py)."""

    # Of the distances from voxels with a measured surface to the nearest free one. The surface lies within a layer of
    # such voxels, and those at its back are the farthest. 0.75 is too little for fits to a recorded kitchen. [by hand]
    clearance_quantile: float = 0.9
    # Voxels. One of the places at half of the clearance and at all of it in front of a surface element was seen to be
    # free, or no camera observed the element from its front. The first lies beyond the surface's own voxel; next
    # to a measured
    # surface, a voxel may count as unobserved although it was seen. Compared with one and three voxels on random
    # worlds. [derived]
    min_clearance: float = 2.0
    max_clearance: float = 8.0  # voxels [by hand]
    voxels_drawn: int = 1 << 17  # at random, among which those with a measured surface are taken [by hand]
    voxels_asked: int = 1000  # of those, at most [by hand]

    guesses: int = 3000  # viewpoints tried: where the tangent planes of three random samples meet [by hand]
    points: int = 500  # samples that each guess is checked on [by hand]
    min_volume: float = 0.05  # spanned by three unit normals: planes closer to parallel meet anywhere [by hand]
    max_distance: float = 30.0  # diagonals from the box's center to a viewpoint [by hand]
    edge_on_cosine: float = 0.05  # of normal and line of sight, below: seen edge-on, 3 degrees [by hand]
    boundary_cosine: float = 0.10  # the same for the final decision, from the refined viewpoint: 6 degrees [by hand]
    facing_away_cosine: float = -0.15  # a smaller cosine is a surface that faces away from the viewpoint [by hand]
    max_facing_away: float = 0.04  # of the samples [by hand]
    min_edge_on: float = 0.15  # of the samples; with fewer no occlusion boundary matters [by hand]
    refinements: int = 3  # least squares steps from the best guess [by hand]


MODEL = ModelConstants()
SIGNATURE = SignatureConstants()
LIBRARY = LibraryConstants()
REFINEMENT = RefinementConstants()
SEARCH = SearchConstants()
FEATURES = FeatureConstants()
EVIDENCE = EvidenceConstants()
VERDICT = VerdictConstants()
RELATION = RelationConstants()
COVARIANCE = CovarianceConstants()
SAMPLING = SamplingConstants()
SCENE = SceneConstants()
SUPPORT_PLANES = SupportPlaneConstants()
OCCLUSION = OcclusionConstants()
