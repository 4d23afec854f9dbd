"""What a detection box shows of a scene: foreground samples, support planes, occlusion boundaries."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from regnf_core.fields.observation import CountingField, SdfField, observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.bundle import Bundle, CopiedOnce
from regnf_core.geometry.metrics import NearestNeighbors
from regnf_core.options import RobustOptions
from regnf_core.robust.constants import OCCLUSION, REFINEMENT, SAMPLING, SCENE, SUPPORT_PLANES
from regnf_core.robust.search.distance_grid import DistanceGrid, distance_grid
from regnf_core.robust.working_frame import (
    Samples,
    UnobservedTest,
    WorkingField,
    WorkingFrame,
    WorkingObservation,
    fixed_generator,
    sample_scene_surface,
    subsample,
)

# Occlusion boundaries: surface that a field shows where the space behind an observed surface begins.
#
# A scene that was observed from one side is solid behind what was observed. The sides of that solid run along the
# lines of sight; they are no real surface. If there is one point from which all surface in the box is seen from its
# front or edge-on, the scene was observed from there alone, and edge-on surface is treated as an occlusion boundary.
# An object that was observed from all sides has no such point: some of its faces point away from each other.


@dataclass(frozen=True, eq=False)
class SingleView:
    """A scene that was observed from one point, ``viewpoint`` (3,) float32: it is unobserved behind its surface."""

    viewpoint: Tensor

    @cached_property
    def _there(self) -> CopiedOnce:
        return CopiedOnce(self.viewpoint)

    def unobserved(self, points: Tensor, values: Tensor) -> Tensor:
        """(M,) bool, where the signed distances (M,) are those of matter. points: not needed."""
        del points
        return values < 0.0

    def faces_unobserved(self, points: Tensor, normals: Tensor) -> Tensor:
        """(M,) bool: which surface elements at points (M, 3) with unit normals (M, 3) face away from the viewpoint."""
        return ((self._there.on(points.device)[0] - points) * normals).sum(-1) < 0.0


def occlusion_boundary(samples: Samples, generator: torch.Generator) -> tuple[Tensor, SingleView | None]:
    """(N,) bool: which samples lie on an occlusion boundary; and from where the scene was observed. None of both unless
    all was observed from one point."""
    points, normals = samples.on_surface().double(), samples.normals.double()
    viewpoint = _viewpoint(points, normals, generator)
    if viewpoint is None:
        return torch.zeros(len(samples), dtype=torch.bool), None
    edge_on: Tensor = _cosines(points, normals, viewpoint[None])[0].abs() < OCCLUSION.boundary_cosine
    return edge_on, SingleView(viewpoint.float()) if bool(edge_on.any()) else None


def _viewpoint(points: Tensor, normals: Tensor, generator: torch.Generator) -> Tensor | None:
    """(3,) from where all surface is seen from its front or edge-on; None where there is no such point."""
    guesses = _meeting_points(points, normals, generator)
    if guesses.shape[0] == 0:
        return None
    few = torch.randperm(points.shape[0], generator=generator)[: OCCLUSION.points]
    cosines = _cosines(points[few], normals[few], guesses)  # (K, J)
    away = (cosines < OCCLUSION.facing_away_cosine).double().mean(1)
    edge_on = (cosines.abs() < OCCLUSION.edge_on_cosine).double().mean(1)
    edge_on[away > OCCLUSION.max_facing_away] = 0.0
    best = int(edge_on.argmax())
    if edge_on[best] < OCCLUSION.min_edge_on:
        return None
    return _refined(guesses[best], points, normals)


def _meeting_points(points: Tensor, normals: Tensor, generator: torch.Generator) -> Tensor:
    """(K, 3) where the tangent planes of three random samples meet: the viewpoint, if all three are edge-on."""
    drawn = torch.randint(points.shape[0], (OCCLUSION.guesses, 3), generator=generator)
    planes = normals[drawn]  # (T, 3, 3)
    heights = (planes * points[drawn]).sum(-1)
    meeting = torch.linalg.det(planes).abs() > OCCLUSION.min_volume
    met: Tensor = torch.linalg.solve(planes[meeting], heights[meeting])
    return met[met.norm(dim=-1) < OCCLUSION.max_distance]


def _refined(viewpoint: Tensor, points: Tensor, normals: Tensor) -> Tensor:
    """The point (3,) nearest to the tangent planes of all edge-on samples, least squares."""
    for _ in range(OCCLUSION.refinements):
        edge_on = _cosines(points, normals, viewpoint[None])[0].abs() < OCCLUSION.edge_on_cosine
        n, p = normals[edge_on], points[edge_on]
        weight = 1.0 / (viewpoint - p).norm(dim=-1, keepdim=True)  # a plane's error grows with the distance
        heights = (n * p).sum(-1, keepdim=True)
        viewpoint = torch.linalg.lstsq(n * weight, heights * weight).solution[:, 0]
    return viewpoint


def _cosines(points: Tensor, normals: Tensor, viewpoints: Tensor) -> Tensor:
    """(K, N) cosines between the normals at points (N, 3) and the lines of sight to viewpoints (K, 3)."""
    along = viewpoints @ normals.T - (points * normals).sum(-1)
    squares = torch.addmm(points.square().sum(-1), viewpoints, points.T, alpha=-2.0)
    squares.add_(viewpoints.square().sum(-1, keepdim=True)).clamp_min_(torch.finfo(squares.dtype).tiny)
    cosines: Tensor = along.div_(squares.sqrt_())
    return cosines


# How rough a sampled surface is, and the samples without that roughness: normals and heights averaged over neighbors.
#
# A fit that was stopped early, or one to noisy images, has bumps as wide as its cells. Steps that look for planes
# need the surface without the bumps, and their size.


@dataclass(frozen=True, eq=False)
class SmoothedSurface(Bundle):
    """Points (N, 3) and unit normals (N, 3) averaged over neighbors on the same sheet.

    roughness: median standard deviation of the neighbors' heights, the points' unit · normal_roughness: 1 - median
    cosine between a sample's own normal and the averaged one; 0 for a plane, about 0.01 for accurate fits.
    """

    points: Tensor
    normals: Tensor
    roughness: float
    normal_roughness: float


def smooth(samples: Samples) -> SmoothedSurface:
    """The samples' surface without its roughness."""
    points = samples.on_surface()
    _, near = NearestNeighbors(points).query_several(points, SCENE.neighbors)
    normals = samples.normals
    for _ in range(SCENE.averaging_rounds):
        neighbors = normals[near]
        alike = (neighbors * normals[:, None]).sum(-1, keepdim=True).clamp_min(0.0)
        normals = torch.nn.functional.normalize((alike * neighbors).sum(1), dim=-1)
    same = ((samples.normals[near] * normals[:, None]).sum(-1) > SCENE.min_same_sheet_cosine).to(points)
    heights = ((points[near] - points[:, None]) * normals[:, None]).sum(-1)
    total = same.sum(1).clamp_min(1.0)
    mean = (heights * same).sum(1) / total
    spread = ((heights - mean[:, None]).square() * same).sum(1).div(total).sqrt()
    cosine = (samples.normals * normals).sum(-1)
    return SmoothedSurface(
        points + mean[:, None] * normals, normals, float(spread.median()), 1.0 - float(cosine.median().clamp_max(1.0))
    )


# Support planes: floors, walls and table tops. All other surface in the region stands in front of them.
#
# A detection box also holds a part of what the object stands on or leans against. Such a plane differs from the
# object's own faces, and which way is up need not be known: all other surface is in front of the plane, while behind
# an object's own face there is the rest of the object. Rough fields have bumpy floors with loose surface beneath.
# There, planes are fitted to the smoothed surface, they are as thick as it is rough, and the rougher it is, the more
# surface may lie behind them. A plane never takes more than a small part of the detection box's height above it: what
# lies flat on a table is thinner than the errors of a rough table.


def support_planes(
    samples: Samples, generator: torch.Generator, edges: Tensor | None = None, outside: Tensor | None = None
) -> Tensor:
    """(N,) bool: which samples lie on a support plane, or behind it. Points in working units, box diagonal 1.

    edges: (3, 3), a row for each edge of the detection box; None: planes are as thick as they need be · outside: (N,)
    bool, samples outside of the detection box; where given, only planes that go on there are support planes. This is
    for scenes that were observed in part: behind an object's faces there is no surface either.
    """
    on_support = torch.zeros(len(samples), dtype=torch.bool)
    if len(samples) == 0:
        return on_support
    surface = smooth(samples)
    if _rough(surface) == 0.0:
        surface = replace(surface, points=samples.on_surface(), normals=samples.normals)
    for _ in range(SUPPORT_PLANES.max_planes):
        rest = (~on_support).nonzero().squeeze(-1)
        if rest.numel() < SUPPORT_PLANES.min_points:
            break
        found = _best_plane(surface[rest], generator, edges, None if outside is None else outside[rest])
        if found is None:
            break
        on_support[rest[found]] = True
    return on_support


def _best_plane(
    surface: SmoothedSurface, generator: torch.Generator, edges: Tensor | None, outside: Tensor | None
) -> Tensor | None:
    """(N,) bool: points on and behind the support plane with the most points, or most outside; None: there is none."""
    c = SUPPORT_PLANES
    basis = surface if outside is None else surface[outside.nonzero().squeeze(-1)]
    if len(basis.points) < c.min_points:
        return None
    points, normals = surface.points, surface.normals
    rough = _rough(surface)
    across, levels = _planes(basis, generator, fitted=rough > 0.0 or outside is not None)
    thickness = torch.full_like(levels, _max_thickness(surface))
    if edges is not None:
        thickness = thickness.minimum(c.max_share_of_height * (across @ edges.to(across).T).abs().sum(-1))
    heights = points @ across.T - levels
    facing = normals @ across.T
    on_plane = (heights.abs() <= thickness) & (facing >= c.min_normal_cosine)
    behind = heights < -c.behind * thickness
    counts = _count_support(on_plane, behind, facing, rough)
    order = counts
    if outside is not None:
        beyond = (on_plane & outside[:, None]).sum(0)
        counts[beyond < c.min_share_outside * counts] = 0
        order = beyond.where(counts > 0, 0)
    best = int(order.argmax())
    if counts[best] < c.min_share * len(points):
        return None
    near = heights[:, best] <= c.removed_thickness * thickness[best]
    return near & ((facing[:, best] >= c.removed_min_cosine) | behind[:, best])


def _count_support(on_plane: Tensor, behind: Tensor, facing: Tensor, rough: float) -> Tensor:
    """(K,) samples on each plane, 0 where too much surface lies behind it. Arguments: (N, K) for N samples, K planes.

    facing: cosines between the normals of samples and planes · rough: 0..1.
    """
    c = SUPPORT_PLANES
    total, counts = on_plane.shape[0], on_plane.sum(0)
    # Surface behind a plane that faces the other way is the far side of a floor or a wall: it does not count.
    far_side = c.far_side_cosines[0] + rough * (c.far_side_cosines[1] - c.far_side_cosines[0])
    loose = torch.where(counts > c.broad_share * total, c.max_share_behind_rough * rough * counts, 0.0)
    counts[(behind & (facing > far_side)).sum(0) > loose.clamp_min(c.max_share_behind * total)] = 0
    return counts


def _rough(surface: SmoothedSurface) -> float:
    """0 for accurate fits, 1 for those stopped after 3 % of their training, or worse."""
    low, high = SUPPORT_PLANES.rough_range
    return min(max((surface.normal_roughness - low) / (high - low), 0.0), 1.0)


def _planes(surface: SmoothedSurface, generator: torch.Generator, fitted: bool) -> tuple[Tensor, Tensor]:
    """Unit normals (K, 3) and heights (K,) above the origin of planes through samples of the surface. fitted: again by
    least squares, to the samples near them."""
    c = SUPPORT_PLANES
    points, normals = surface.points, surface.normals
    picks = torch.randperm(len(points), generator=generator)[: c.candidates]
    n, middles = normals[picks], points[picks]
    squares = (points[:, :, None] * points[:, None, :]).reshape(-1, 9)
    for _ in range(c.fit_rounds if fitted else 0):
        heights = points @ n.T - (middles * n).sum(-1)
        near = (heights.abs() <= c.fit_thickness * _max_thickness(surface)) & (normals @ n.T >= c.fit_min_normal_cosine)
        weights = near.to(points).T  # (K, N)
        total = weights.sum(1, keepdim=True).clamp_min(1.0)
        middle = weights @ points / total
        spread = (weights @ squares / total).reshape(-1, 3, 3) - middle[:, :, None] * middle[:, None, :]
        thinnest = torch.linalg.eigh(spread.double())[1][:, :, 0].to(n)
        enough = total >= c.min_points
        n = torch.where(enough, thinnest * torch.sign((thinnest * n).sum(-1, keepdim=True)), n)
        middles = torch.where(enough, middle, middles)
    return n, (middles * n).sum(-1)


def _max_thickness(surface: SmoothedSurface) -> float:
    """Half the thickness of a plane of such roughness, whatever stands on it."""
    c = SUPPORT_PLANES
    return min(max(c.thickness, c.thickness_per_roughness * surface.roughness), c.max_thickness)


# What one detection shows of a scene: sampled once, registered with any number of objects.


@dataclass(frozen=True, eq=False)
class SceneView(Bundle):
    """The surface in the detection box. Working frame: the box's center at 0, its diagonal 1.

    foreground: the samples in front of floors and walls · spacing: between samples · occlusion_boundary_share: of the
    samples, removed as occlusion boundary or as surface that was not observed · evaluations: of the scene's field, that
    it took to make this · observation: of the scene; None where the field has none.
    """

    frame: WorkingFrame
    detection: OrientedBox
    foreground: Samples
    spacing: float
    occlusion_boundary_share: float
    evaluations: int
    observation: WorkingObservation | None = None

    @property
    def of_thing(self) -> bool:
        """Whether a detection in an image said which surface is the object's, see
        :class:`regnf_core.fields.observation.Observation`; the box has that camera's axes then."""
        return self.observation is not None and self.observation.of_thing

    @property
    def ahead(self) -> float:
        """How far in front of the foreground an object is asked, of the :class:`SurfacePair` that it is a part of."""
        return SCENE.ahead_of_thing if self.of_thing else 0.0

    def field(self, scene: SdfField) -> WorkingField:
        """The scene's field, the one that this view is of, in the working frame."""
        return WorkingField(scene, self.frame)

    @cached_property
    def normal_roughness(self) -> float:
        """Of the foreground, see :class:`regnf_core.robust.scene.SmoothedSurface`."""
        return smooth(self.foreground).normal_roughness

    @property
    def max_offset(self) -> float:
        """How far the surface may lie outside or inside the object's, object diameters."""
        allowed = SCENE.offset_per_normal_roughness * (self.normal_roughness - SCENE.smooth_normal_roughness)
        return min(max(allowed, 0.0), REFINEMENT.max_offset)

    @cached_property
    def distance_grid(self) -> DistanceGrid:
        """Distances to the foreground, on a grid."""
        return distance_grid(self.foreground, self.spacing)


def view_scene(scene: SdfField, detection: OrientedBox, options: RobustOptions) -> SceneView:
    """Sample the scene's surface in the box; remove floors, walls, occlusion boundaries and unobserved surface.

    The same at every call: seeds of registrations do not move the samples. Raises InvalidDetectionError
    (DETECTION_OUTSIDE_SCENE), NoSurfaceError (NO_SURFACE_IN_DETECTION), InvalidInputError (FIELD_NOT_FINITE).
    """
    counted = CountingField(scene)
    for further in range(SCENE.most_further + 1):
        view = _sampled_view(counted, detection, options.scene_samples, further)
        extent = (view.foreground.points @ detection.rotation.to(view.foreground.points)).aminmax(dim=0)
        thick = float((extent.max - extent.min).min()) >= SCENE.thick * view.spacing
        if thick and len(view.foreground) >= options.scene_samples * SCENE.enough_foreground:
            break
    return replace(view, evaluations=counted.evaluations)


def _sampled_view(scene: SdfField, detection: OrientedBox, limit: int, further: int) -> SceneView:
    """The view with at most ``limit`` samples of the foreground. further: by how many halvings the cells are finer."""
    generator = fixed_generator()
    sampled = sample_scene_surface(scene, detection, limit * 4**further, generator, SAMPLING.levels + further)
    everything, known = sampled.samples, observation_of(scene)
    observation = None if known is None else WorkingObservation(known, sampled.frame)
    unobserved: UnobservedTest | None = observation
    if observation is None:
        removed, unobserved = occlusion_boundary(everything, generator)
    else:
        removed = ~observation.on_surface(everything.points)
    outside = None
    if unobserved is not None:
        hidden = unobserved.faces_unobserved(everything.points, everything.normals)
        everything = replace(everything, unobserved=unobserved, hidden=hidden)
    observed = everything[~removed]
    if unobserved is not None:
        half = (detection.size / detection.diagonal / 2).to(observed.points)
        outside = ~((observed.points @ detection.rotation.to(observed.points)).abs() <= half).all(-1)
    edges = detection.rotation.mT * (detection.size / detection.diagonal)[:, None]
    foreground = observed
    if observation is None or not observation.of_thing:  # else what the object stands on is known
        foreground = observed[~support_planes(observed, generator, edges, outside)]
    if len(foreground) < SCENE.min_foreground:
        foreground = observed if len(observed) >= SCENE.min_foreground else everything
    share = float(removed.float().mean())
    foreground = subsample(foreground, limit, generator)
    return SceneView(sampled.frame, detection, foreground, sampled.spacing, share, 0, observation)
