"""What a detection shows of a scene: smoothing, support planes, occlusion.

The package's docstring explains the sources.
"""

from __future__ import annotations

from dataclasses import dataclass


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
