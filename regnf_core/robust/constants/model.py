"""An object's model: extremal points, symmetries, signature.

The package's docstring explains the sources.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

# One stage of a coarse-to-fine refinement: how many samples, which kernel widths, which poses go on.


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


# The search of a library.
#
# The package's docstring explains the sources.


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


LIBRARY = LibraryConstants()


# The refinement on the fields.
#
# The package's docstring explains the sources.

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


# The search of poses from samples alone, and seeds from feature matches.
#
# The package's docstring explains the sources.

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


SEARCH = SearchConstants()
FEATURES = FeatureConstants()
