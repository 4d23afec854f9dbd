"""Samples of both surfaces, evenly spread over the surface in the region, with normals and exact field values.

No length is absolute: all follow from the detection box and from the object's own extent. A sample is a point close to
the surface together with the field's value there, which the residuals take into account; so two gradient evaluations
for each point are enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.fields.observation import observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.points import diameter
from regnf_core.robust.constants import SAMPLING
from regnf_core.robust.samples import Samples
from regnf_core.robust.working_frame import WorkingField, WorkingFrame, WorkingObservation
from regnf_core.surface.projection import project_to_surface
from regnf_core.surface.requirements import (
    MIN_POINTS,
    require_box_in_scene,
    require_object_surface,
    require_scene_surface,
)
from regnf_core.surface.surface_cells import Cells, crop_to_surface, surface_cells


@dataclass(frozen=True, eq=False)
class SampledField:
    """A field, its working frame, and its samples there. spacing: between samples, working units."""

    field: WorkingField
    frame: WorkingFrame
    samples: Samples
    spacing: float


def sample_object_surface(obj: SdfField, limit: int, generator: torch.Generator) -> SampledField:
    """At most ``limit`` samples of the object; the working frame has the surface's centroid at 0 and diameter 1.

    Of an object that says what was observed of it, surface that nobody measured, or nobody can have seen from its
    front, is left out, unless too little else is there: a scan shows such surface where it ends, beneath the object and
    behind its walls.
    Raises NoSurfaceError (NO_SURFACE_IN_OBJECT), InvalidInputError (FIELD_NOT_FINITE).
    """
    low, high = obj.bounds
    rough = _box_frame(low, high)
    field = WorkingField(obj, rough)
    low, high = rough.into(low).double(), rough.into(high).double()
    known = observation_of(obj)
    observation = None if known is None else WorkingObservation(known, rough)
    extent = None if observation is None else observation.measured_extent()
    if extent is not None:
        low, high = torch.maximum(low, extent[0]), torch.minimum(high, extent[1])
    inner = crop_to_surface(field.value, low, high, SAMPLING.object_base)
    cells, space = surface_cells(field.value, *inner, SAMPLING.object_base, SAMPLING.levels)
    found = _samples_near(field, cells, limit, generator)
    found = found[space.faces_outside(found.points, found.normals)]
    inside = ((found.points >= low.float()) & (found.points <= high.float())).all(-1)
    found = found[inside]
    if observation is not None:
        measured = observation.on_surface(found.points)
        measured &= ~observation.faces_unobserved(found.points, found.normals)
        found = found[measured] if int(measured.sum()) >= MIN_POINTS else found
    require_object_surface(len(found))
    surface = found.on_surface()
    size = diameter(surface)
    center = surface.double().mean(0)
    frame = WorkingFrame(rough.out_of(center[None])[0], rough.length * size)
    samples = Samples((found.points - center.float()) / size, found.values / size, found.normals)
    return SampledField(WorkingField(obj, frame), frame, samples, cells.edge / size)


def sample_scene_surface(
    scene: SdfField, detection: OrientedBox, limit: int, generator: torch.Generator
) -> SampledField:
    """At most ``limit`` samples of the scene within the grown box; working frame: the box's center, its diagonal 1.

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

    cells, space = surface_cells(value, -half, half, SAMPLING.scene_base, SAMPLING.levels)
    cells = Cells(cells.centers @ rotation.T, cells.values, cells.edge)
    found = _samples_near(field, cells, limit, generator)
    axes = rotation.to(found.points)
    found = found[space.faces_outside(found.points @ axes, found.normals @ axes)]
    bounds = frame.into(scene.bounds)
    found = found[((found.points >= bounds[0]) & (found.points <= bounds[1])).all(-1)]
    require_scene_surface(len(found))
    return SampledField(field, frame, found, cells.edge)


def _box_frame(low: Tensor, high: Tensor) -> WorkingFrame:
    return WorkingFrame(((low + high) / 2).double(), float((high - low).norm()))


def _samples_near(field: WorkingField, cells: Cells, limit: int, generator: torch.Generator) -> Samples:
    """At most ``limit`` samples: one Newton step from the cells' centers to the surface, value and normal at its
    end."""
    close = (cells.values.abs() <= SAMPLING.max_cell_distance * cells.edge).nonzero().squeeze(-1)
    if close.numel() > limit:
        close = close[torch.randperm(close.numel(), generator=generator)[:limit]]
    start = cells.centers[close].float()
    if start.shape[0] == 0:
        return Samples(start, start[:, 0], start)
    found = project_to_surface(field.value_and_gradient, start, 1, SAMPLING.min_slope)
    length = found.gradient.norm(dim=-1)
    kept = (found.distance.abs() <= SAMPLING.max_sample_distance * cells.edge) & (length >= SAMPLING.min_slope)
    return Samples(found.points[kept], found.distance[kept], found.gradient[kept] / length[kept, None])
