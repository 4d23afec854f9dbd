"""The search of poses from samples alone, and seeds from feature matches.

The package's docstring explains the sources.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from regnf_core.robust.stage import Stage

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
