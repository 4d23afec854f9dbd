"""What one detection shows of a scene: sampled once, matched against as many objects as one likes."""

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
from regnf_core.robust.refine.levenberg_marquardt import MOST_OFFSET
from regnf_core.robust.residuals import Samples, Unseen
from regnf_core.robust.samples import SampledField, sample_scene_surface
from regnf_core.robust.scene.occlusion_boundary import behind_surfaces, shadow_walls
from regnf_core.robust.scene.smoothing import smoothed
from regnf_core.robust.scene.support_planes import support
from regnf_core.robust.search.distance_grid import ProxyField, proxy_of
from regnf_core.robust.working_frame import WorkingField, WorkingFrame, WorkingObservation

_FEWEST = 30  # samples in front of the supports; with fewer, the supports are kept after all
_SMOOTH, _OFFSET_PER_INCOHERENCE = 0.012, 2.0
"""What is smooth is no thicker than it should be either: there an offset would make one box another."""


@dataclass(frozen=True, eq=False)
class SceneView:
    """The surface in the detection box. Working frame: the box's center at 0, its diagonal 1.

    foreground: the samples that stand in front of floors and walls · spacing: between samples · shadow_share: of the
    samples, set aside as the walls of shadows · evaluations: of the scene's field, that it took to make this.
    """

    frame: WorkingFrame
    detection: OrientedBox
    foreground: Samples
    spacing: float
    shadow_share: float
    evaluations: int

    def field(self, scene: SdfField) -> WorkingField:
        """The scene's field, the one that this view is of, in the working frame."""
        return WorkingField(scene, self.frame)

    @cached_property
    def incoherence(self) -> float:
        """How rough the foreground's normals are, see :class:`regnf_core.robust.scene.smoothing.Smoothed`."""
        return smoothed(self.foreground).incoherence

    @property
    def most_offset(self) -> float:
        """How far the surface may lie outside or inside the object's, object diameters."""
        allowed = _OFFSET_PER_INCOHERENCE * (self.incoherence - _SMOOTH)
        return min(max(allowed, 0.0), MOST_OFFSET)

    @cached_property
    def proxy(self) -> ProxyField:
        """The distance table made from the foreground."""
        return proxy_of(self.foreground, self.spacing)


def view_scene(scene: SdfField, detection: OrientedBox, options: RobustOptions, seed: int) -> SceneView:
    """Sample the scene's surface in the box; set floors, walls and the borders of shadows aside.

    Deterministic for ``seed``. Raises InvalidDetectionError (DETECTION_OUTSIDE_SCENE), NoSurfaceError
    (NO_SURFACE_IN_DETECTION), InvalidInputError (FIELD_NOT_FINITE).
    """
    generator = torch.Generator().manual_seed(seed)
    counted = CountingField(scene)
    sampled = sample_scene_surface(counted, detection, options.scene_samples, generator)
    walls, unseen = _what_is_not_known(counted, sampled, generator)
    seen = replace(sampled.samples[~walls], unseen=unseen)
    outside = None if unseen is None else ~_within(seen, detection)
    foreground = seen[~support(seen, generator, outside)]
    if len(foreground) < _FEWEST:
        foreground = seen if len(seen) >= _FEWEST else sampled.samples
    return SceneView(
        sampled.frame, detection, foreground, sampled.spacing, float(walls.float().mean()), counted.evaluations
    )


def _what_is_not_known(
    scene: SdfField, sampled: SampledField, generator: torch.Generator
) -> tuple[Tensor, Unseen | None]:
    """Which samples (N,) rest on nothing, and where else nobody looked: as the field says, or by its shadows."""
    observation = observation_of(scene)
    if observation is not None:
        seen = WorkingObservation(observation, sampled.frame)
        return ~seen.on_surface(sampled.samples.points), seen.nobody_looked
    walls = shadow_walls(sampled.samples, generator)
    return walls, behind_surfaces if bool(walls.any()) else None


def _within(samples: Samples, detection: OrientedBox) -> Tensor:
    """(N,) bool: which samples lie in the detection box itself."""
    half = (detection.size / detection.diagonal / 2).to(samples.points)
    within: Tensor = ((samples.points @ detection.rotation.to(samples.points)).abs() <= half).all(-1)
    return within
