"""Working frames: both fields are centered and of size one, so that no number in this package depends on their
units."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from regnf_core.errors import InvalidInputError
from regnf_core.fields.observation import Observation, SdfField, observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.bundle import Bundle, CopiedOnce
from regnf_core.geometry.metrics import NearestNeighbors, diameter
from regnf_core.geometry.sim3 import Sim3
from regnf_core.native import steps as compiled
from regnf_core.native.steps import Kept, NativeModel, native_model
from regnf_core.robust.constants import EVIDENCE, OCCLUSION, SAMPLING
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from regnf_core.surface.requirements import MIN_POINTS, require_box_in_scene, require_surface
from regnf_core.surface.result_clouds import project_to_surface
from regnf_core.surface.surface_cells import Cells, crop_to_surface, surface_cells

# Samples of a surface, and what tells where a scene was not observed.


class UnobservedTest(Protocol):
    """Tells what was not observed of a scene, in the samples' frame."""

    def unobserved(self, points: Tensor, values: Tensor) -> Tensor:
        """(M,) bool: which of the points (M, 3) were not observed. values: (M,) the signed distances there, object
        diameters."""
        ...

    def faces_unobserved(self, points: Tensor, normals: Tensor) -> Tensor:
        """(M,) bool: which surface elements at points (M, 3) with unit normals (M, 3) nobody can have seen, because the
        space in front of them was not seen to be free."""
        ...


@dataclass(frozen=True, eq=False)
class Samples(Bundle):
    """Points near a surface: points (N, 3), the field's value there (N,), its unit normals (N, 3). float32.

    unobserved: where the field shows something that was not observed; None: everything was observed · hidden: (N,)
    bool, samples of a scene that nobody can have seen from their front; they tell nothing where the object faces
    another way.
    """

    points: Tensor
    values: Tensor
    normals: Tensor
    unobserved: UnobservedTest | None = None
    hidden: Tensor | None = None

    def __len__(self) -> int:
        return len(self.points)

    def on_surface(self) -> Tensor:
        """The points (N, 3) moved onto the surface along their normals."""
        return self.points - self.values.unsqueeze(-1) * self.normals


def fixed_generator() -> torch.Generator:
    """A new generator for what is the same in every registration, whatever its seed."""
    return torch.Generator().manual_seed(0)


def subsample(samples: Samples, limit: int, generator: torch.Generator) -> Samples:
    """At most ``limit`` of the samples, at random: drawn on the CPU, so that a seed means the same on every device."""
    if len(samples) <= limit:
        return samples
    drawn = torch.randperm(len(samples), generator=generator)[:limit]
    return samples[drawn.to(samples.points.device)]


def split(samples: Samples, held_out: float, generator: torch.Generator) -> tuple[Samples, Samples]:
    """Two disjoint random parts; the second, a share ``held_out`` (0..1), is for the verdict alone."""
    order = torch.randperm(len(samples), generator=generator).to(samples.points.device)
    cut = len(samples) - int(held_out * len(samples))
    return samples[order[:cut]], samples[order[cut:]]


# How far from a measured surface an observation begins to know of free space.
#
# Nearer to a measured surface than the noise of the depths, nothing is said to be free. And where depths of one
# surface scatter, the voxels in which a surface was measured are a layer, and the surface lies within it. What tells
# whether a surface element was seen from its front must look beyond both.


def clearance(observation: Observation) -> float:
    """Voxels from a voxel with a measured surface to the nearest free one: a quantile of them, within bounds (see
    ``OCCLUSION``).

    2 for exact depths, more for noisy ones. The same for every call.
    """
    states = observation.states
    drawn = torch.randint(states.numel(), (OCCLUSION.voxels_drawn,), generator=fixed_generator())
    measured = drawn[states.view(-1)[drawn] == SURFACE][: OCCLUSION.voxels_asked]
    if len(measured) == 0:
        return OCCLUSION.min_clearance
    _, down, across = states.shape  # torch.unravel_index loads a library of symbols, which takes half a second
    places = [measured // (down * across), measured // across % down, measured % across]
    centers = torch.stack(places, -1)[:, None] + 0.5
    directions = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)
    directions = normalize(directions[directions.any(1)])
    grid = replace(observation, low=torch.zeros(3).double(), voxel=1.0, T_grid_frame=None)
    nearest = torch.full((len(centers),), OCCLUSION.max_clearance)
    for step in range(int(OCCLUSION.max_clearance), 0, -1):
        nearest[(grid.at(centers + step * directions) == FREE).any(1)] = float(step)
    return max(OCCLUSION.min_clearance, float(nearest.quantile(OCCLUSION.clearance_quantile)))


# Which device the work is done on, and what may be asked of it.
#
# Search and refinement run where the scene's field is. To read a number there, the CPU waits until all earlier work
# is done; so nothing is read within an iteration. What one pose decides on the next is decided on the CPU, once a
# stage.


def working_device(field: SdfField) -> torch.device:
    """Where a registration in this scene computes: the field's device, or the CPU where that has no float64 (mps)."""
    return torch.device("cpu") if field.device.type == "mps" else field.device


def on_host(values: Tensor) -> bool:
    """Whether to read the values costs nothing."""
    return values.device.type == "cpu"


@dataclass(frozen=True, eq=False)
class WorkingFrame:
    """x_work = (x - center) / length. center: (3,) float64, field frame · length: field units."""

    center: Tensor
    length: float

    def into(self, points: Tensor) -> Tensor:
        """Points (N, 3) of the field's frame in the working frame, float32."""
        return ((points.double().cpu() - self.center) / self.length).float()

    def out_of(self, points: Tensor) -> Tensor:
        """Points (N, 3) of the working frame in the field's frame, float64."""
        return points.double().cpu() * self.length + self.center

    def to_field(self) -> Sim3:
        """The working frame's points in the field's frame."""
        return Sim3(
            torch.tensor(self.length, dtype=torch.float64), torch.eye(3, dtype=torch.float64), self.center.clone()
        )


class WorkingField:
    """A field in its working frame: value and gradient at (M, 3) float32 points, results on the points' device.

    Points on the field's device are not copied. On the CPU, values are checked at once; elsewhere it would take a copy
    to ask, so what is not finite is remembered there until ``require_finite``.
    """

    def __init__(self, field: SdfField, frame: WorkingFrame) -> None:
        self.field = field
        self.frame = frame
        self._center = CopiedOnce(frame.center)
        self._not_finite: Tensor | None = None

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (M,), working units. Raises InvalidInputError (FIELD_NOT_FINITE)."""
        distance = self.field.signed_distance(self._own(points)).to(points.device) / self.frame.length
        return self._finite(distance.float())

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (M,), working units, and its gradient (M, 3). Raises InvalidInputError (FIELD_NOT_FINITE)."""
        distance, gradient = self.field.signed_distance_and_gradient(self._own(points))
        distance, gradient = distance.to(points.device), gradient.to(points.device)
        return self._finite(distance.float() / self.frame.length), self._finite(gradient.float())

    def native_model(self) -> NativeModel | None:
        """The same for compiled code, where the field has such."""
        found = native_model(self.field)
        return (
            None
            if found is None
            else found.seen_by(self.frame.length * np.eye(3), self.frame.center, 1.0 / self.frame.length)
        )

    def require_finite(self) -> None:
        """Raises InvalidInputError (FIELD_NOT_FINITE) where a value since the last call was not finite."""
        found, self._not_finite = self._not_finite, None
        if found is not None and bool(found):
            raise not_finite()

    def _own(self, points: Tensor) -> Tensor:
        """Points (M, 3) in the field's frame, on its device."""
        (center,) = self._center.on(points.device)
        return (points.double() * self.frame.length + center).to(self.field.device)

    def _finite(self, values: Tensor) -> Tensor:
        if not len(values):
            return values
        largest = values.abs().amax()  # NaN where there is one: three operations, and isfinite takes seven
        if on_host(values):
            if not math.isfinite(float(largest)):
                raise not_finite()
            return values
        faulty = ~torch.isfinite(largest)
        self._not_finite = faulty if self._not_finite is None else self._not_finite | faulty
        return values


class WorkingObservation:
    """What was observed of a field, in its working frame: at (M, 3) float32 points on any device, results there."""

    def __init__(self, observation: Observation, frame: WorkingFrame) -> None:
        observation = observation.seen_in(frame.to_field())
        T = Sim3.identity() if observation.T_grid_frame is None else observation.T_grid_frame
        to_cells = T.scale / observation.voxel
        turn = (to_cells * T.rotation).float().mT.contiguous()
        shift = ((T.translation - observation.low) / observation.voxel).float()
        ahead = (clearance(observation) / to_cells).float()
        states, counts = observation.states.reshape(-1), torch.tensor(observation.states.shape)
        self._observation = observation
        self.of_thing = observation.of_thing
        # A point x is in the voxel floor(x turn + shift), z fastest.
        self._parts = CopiedOnce(states, counts, turn, shift, ahead)
        self._compiled: Kept | None = None

    def compiled(self) -> Kept:
        """The same for compiled code, on the CPU."""
        if self._compiled is None:
            states, counts, turn, shift, ahead = self._parts.on(torch.device("cpu"))
            self._compiled = compiled.observation(states, counts, turn, shift, float(ahead), EVIDENCE.agreement)
        return self._compiled

    def measured_extent(self) -> Tensor | None:
        """(2, 3) float64: lowest and highest corner of where surface was measured; None where none was."""
        return self._observation.measured_extent()

    def on_surface(self, points: Tensor) -> Tensor:
        """(M,) bool: a surface was measured there."""
        return self._at(points) == SURFACE

    def unobserved(self, points: Tensor, values: Tensor) -> Tensor:
        """(M,) bool: which points (M, 3), with these signed distances (M,) in object diameters, were not observed.

        Those in unseen voxels, and those off the surface in voxels where one was measured: such a voxel does not tell
        which part of it is free.
        """
        states = self._at(points)
        return (states == UNSEEN) | ((states == SURFACE) & (values.abs() > EVIDENCE.agreement))

    def faces_unobserved(self, points: Tensor, normals: Tensor) -> Tensor:
        """(M,) bool: no line of sight passed in front of these surface elements, whose unit normals are (M, 3)."""
        ahead = self._parts.on(points.device)[-1] * normals
        return (self._at(points + 0.5 * ahead) != FREE) & (self._at(points + ahead) != FREE)

    def _at(self, points: Tensor) -> Tensor:
        """The states (M,) at points (M, 3); UNSEEN beyond the grid."""
        states, counts, turn, shift, _ = self._parts.on(points.device)
        cells = (points @ turn).add_(shift).floor_().long()
        within = ((cells >= 0) & (cells < counts)).all(-1)
        x, y, z = torch.minimum(cells.clamp_min_(0), counts - 1).unbind(-1)
        index = x.mul(counts[1]).add_(y).mul_(counts[2]).add_(z)
        return torch.where(within, states[index], UNSEEN)


def not_finite() -> InvalidInputError:
    """For what a field said."""
    return InvalidInputError("the field evaluates to NaN or infinity", reason="FIELD_NOT_FINITE")


# Samples of both surfaces, evenly spread over the surface in the region, with normals and exact field values.
#
# No length is absolute: all follow from the detection box and from the object's own extent. A sample is a point close
# to the surface together with the field's value there, which the residuals take into account; so two gradient
# evaluations for each point are enough.


@dataclass(frozen=True, eq=False)
class SampledField:
    """A field, its working frame, and its samples there. spacing: between samples, working units · missed: of faces of
    thin walls that have none among the samples; None: it was not looked for."""

    field: WorkingField
    frame: WorkingFrame
    samples: Samples
    spacing: float
    missed: Samples | None = None


def sample_object_surface(obj: SdfField, limit: int, generator: torch.Generator) -> SampledField:
    """At most ``limit`` samples of the object; the working frame has the surface's centroid at 0 and diameter 1.

    Of an object that says what was observed of it, surface that nobody measured, or nobody can have seen from its
    front, is left out, unless too little else is there: a scan shows such surface where it ends, beneath the object and
    behind its walls.
    Raises NoSurfaceError (NO_SURFACE_IN_OBJECT), InvalidInputError (FIELD_NOT_FINITE).
    """
    low, high = obj.bounds
    rough = WorkingFrame(((low + high) / 2).double(), float((high - low).norm()))
    field = WorkingField(obj, rough)
    low, high = rough.into(low).double(), rough.into(high).double()
    known = observation_of(obj)
    observation = None if known is None else WorkingObservation(known, rough)
    extent = None if observation is None else observation.measured_extent()
    if extent is not None:
        low, high = torch.maximum(low, extent[0]), torch.minimum(high, extent[1])
    inner = crop_to_surface(field.value, low, high, SAMPLING.object_base)
    cells, space = surface_cells(field.value, *inner, SAMPLING.object_base, SAMPLING.levels, limit // 4)
    found = _samples_near(field, cells, limit, generator)
    missed = _of_missed_faces(field, cells, found)
    found, missed = (
        one[space.faces_outside(one.points, one.normals) & _within(one.points, low, high)] for one in (found, missed)
    )
    if observation is not None:
        measured = observation.on_surface(found.points)
        measured &= ~observation.faces_unobserved(found.points, found.normals)
        found = found[measured] if int(measured.sum()) >= MIN_POINTS else found
        missed = missed[:0]
    require_surface(len(found), of_object=True)
    surface = found.on_surface()
    size = diameter(surface)
    center = surface.double().mean(0)
    frame = WorkingFrame(rough.out_of(center[None])[0], rough.length * size)
    samples, other = (
        Samples((one.points - center.float()) / size, one.values / size, one.normals) for one in (found, missed)
    )
    return SampledField(WorkingField(obj, frame), frame, samples, cells.edge / size, other)


def sample_scene_surface(
    scene: SdfField, detection: OrientedBox, limit: int, generator: torch.Generator, levels: int = SAMPLING.levels
) -> SampledField:
    """At most ``limit`` samples of the scene within the grown box; working frame: the box's center, its diagonal 1.

    levels: how often cells are subdivided.
    Raises InvalidDetectionError (DETECTION_OUTSIDE_SCENE), NoSurfaceError (NO_SURFACE_IN_DETECTION),
    InvalidInputError (FIELD_NOT_FINITE).
    """
    require_box_in_scene(scene, detection)
    frame = WorkingFrame(detection.center.double(), detection.diagonal)
    field = WorkingField(scene, frame)
    half = detection.size.double() / detection.diagonal * (SAMPLING.box_growth / 2)
    rotation = detection.rotation.double()

    def value(local: Tensor) -> Tensor:
        return field.value(local.to(rotation) @ rotation.T)

    low, high = -half, half
    known = observation_of(scene)
    if known is not None and known.of_thing and len(seen := known.measured()):
        # Finely where the object was seen, not where its back may be.
        seen = frame.into(seen).double() @ rotation
        edge = known.voxel / detection.diagonal
        low, high = low.maximum(seen.amin(0) - edge), high.minimum(seen.amax(0) + edge)
        low, high = (low, high) if bool((high > low).all()) else (-half, half)
    cells, space = surface_cells(value, low, high, SAMPLING.scene_base, levels)
    cells = Cells(cells.centers @ rotation.T, cells.values, cells.edge)
    found = _samples_near(field, cells, limit, generator)
    axes = rotation.to(found.points)
    found = found[space.faces_outside(found.points @ axes, found.normals @ axes)]
    bounds = frame.into(scene.bounds)
    found = found[((found.points >= bounds[0]) & (found.points <= bounds[1])).all(-1)]
    require_surface(len(found), of_object=False)
    return SampledField(field, frame, found, cells.edge)


def _samples_near(field: WorkingField, cells: Cells, limit: int, generator: torch.Generator) -> Samples:
    """At most ``limit`` samples: one Newton step from cells' centers to the surface, value and normal at its end."""
    close = (cells.values.abs() <= SAMPLING.max_cell_distance * cells.edge).nonzero().squeeze(-1)
    if close.numel() > limit:
        close = close[torch.randperm(close.numel(), generator=generator)[:limit]]
    return _projected(field, cells[close])


def _of_missed_faces(field: WorkingField, cells: Cells, found: Samples) -> Samples:
    """Samples of the farther cells, where none of those ``found`` faces the same way nearby.

    Of a wall thinner than a cell that lies along the grid, only the face that is nearer to the cells' centers has
    close ones.
    """
    far = _projected(field, cells[(cells.values.abs() > SAMPLING.max_cell_distance * cells.edge).nonzero().squeeze(-1)])
    if not len(far) or not len(found):
        return far[:0]
    apart, near = NearestNeighbors(found.points).query_several(far.points, SAMPLING.face_neighbors)
    alike = (found.normals[near] * far.normals[:, None]).sum(-1) >= EVIDENCE.min_inlier_cosine
    return far[~(alike & (apart <= cells.edge)).any(1)]


def _within(points: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return ((points >= low.float()) & (points <= high.float())).all(-1)


def _projected(field: WorkingField, cells: Cells) -> Samples:
    """One Newton step from the cells' centers to the surface; samples that do not end near it are left out."""
    start = cells.centers.float()
    if start.shape[0] == 0:
        return Samples(start, start[:, 0], start)
    found = project_to_surface(field.value_and_gradient, start, 1, SAMPLING.min_slope)
    length = found.gradient.norm(dim=-1)
    kept = (found.distance.abs() <= SAMPLING.max_sample_distance * cells.edge) & (length >= SAMPLING.min_slope)
    return Samples(found.points[kept], found.distance[kept], found.gradient[kept] / length[kept, None])
