"""What one detection shows of a scene: sampled once, registered with any number of objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.fields.counting import CountingField
from regnf_core.fields.observation import observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.options import RobustOptions
from regnf_core.robust.constants import REFINEMENT, SCENE
from regnf_core.robust.samples import Samples, UnobservedTest, fixed_generator
from regnf_core.robust.sampling import SampledField, sample_scene_surface
from regnf_core.robust.scene.occlusion_boundary import occlusion_boundary
from regnf_core.robust.scene.smoothing import smooth
from regnf_core.robust.scene.support_planes import support_planes
from regnf_core.robust.search.distance_grid import DistanceGrid, distance_grid
from regnf_core.robust.working_frame import WorkingField, WorkingFrame, WorkingObservation


@dataclass(frozen=True, eq=False)
class SceneView:
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

    def field(self, scene: SdfField) -> WorkingField:
        """The scene's field, the one that this view is of, in the working frame."""
        return WorkingField(scene, self.frame)

    def to(self, device: torch.device | str) -> SceneView:
        """The same view with its samples on another device; its roughness is measured once. Itself where it is there
        already."""
        if self.foreground.points.device == torch.device(device):
            return self
        moved = replace(self, foreground=self.foreground.to(device))
        moved.__dict__["normal_roughness"] = self.normal_roughness
        return moved

    @cached_property
    def normal_roughness(self) -> float:
        """Of the foreground, see :class:`regnf_core.robust.scene.smoothing.SmoothedSurface`."""
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
    generator = fixed_generator()
    counted = CountingField(scene)
    sampled = sample_scene_surface(counted, detection, options.scene_samples, generator)
    removed, unobserved = _unobserved_surface(counted, sampled, generator)
    everything = _with_hidden(replace(sampled.samples, unobserved=unobserved))
    observed = everything[~removed]
    outside = None if unobserved is None else ~_within(observed, detection)
    edges = detection.rotation.mT * (detection.size / detection.diagonal)[:, None]
    foreground = observed[~support_planes(observed, generator, edges, outside)]
    if len(foreground) < SCENE.min_foreground:
        foreground = observed if len(observed) >= SCENE.min_foreground else everything
    share = float(removed.float().mean())
    observation = _observation(counted, sampled)
    return SceneView(sampled.frame, detection, foreground, sampled.spacing, share, counted.evaluations, observation)


def _observation(scene: SdfField, sampled: SampledField) -> WorkingObservation | None:
    observation = observation_of(scene)
    return None if observation is None else WorkingObservation(observation, sampled.frame)


def _with_hidden(samples: Samples) -> Samples:
    """The samples, and which of them nobody can have seen from their front."""
    if samples.unobserved is None:
        return samples
    return replace(samples, hidden=samples.unobserved.faces_unobserved(samples.points, samples.normals))


def _unobserved_surface(
    scene: SdfField, sampled: SampledField, generator: torch.Generator
) -> tuple[Tensor, UnobservedTest | None]:
    """Which samples (N,) were not observed, and where else nothing was: by the field's observation, where it has one,
    else by its occlusion boundaries."""
    observed = _observation(scene, sampled)
    if observed is not None:
        return ~observed.on_surface(sampled.samples.points), observed
    return occlusion_boundary(sampled.samples, generator)


def _within(samples: Samples, detection: OrientedBox) -> Tensor:
    """(N,) bool: which samples lie in the detection box itself."""
    half = (detection.size / detection.diagonal / 2).to(samples.points)
    within: Tensor = ((samples.points @ detection.rotation.to(samples.points)).abs() <= half).all(-1)
    return within
