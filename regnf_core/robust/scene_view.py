"""What one detection shows of a scene: sampled once, matched against as many objects as one likes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch

from regnf_core.box import OrientedBox
from regnf_core.fields.base import CountingField, SdfField
from regnf_core.options import RobustOptions
from regnf_core.robust.frame import WorkingField, WorkingFrame
from regnf_core.robust.levenberg import MOST_OFFSET
from regnf_core.robust.proxy import ProxyField, proxy_of
from regnf_core.robust.residuals import Samples
from regnf_core.robust.samples import sample_scene_surface
from regnf_core.robust.shadow import shadow_walls
from regnf_core.robust.smoothing import smoothed
from regnf_core.robust.support import support

_FEWEST = 30  # samples in front of the supports; with fewer, the supports are kept after all
_SMOOTH, _OFFSET_PER_INCOHERENCE = 0.012, 2.0
"""What is smooth is no thicker than it should be either: there an offset would make one box another."""


@dataclass(frozen=True, eq=False)
class SceneView:
    """The surface in the detection box. Working frame: the box's centre at 0, its diagonal 1.

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
        """How rough the foreground's normals are, see :class:`regnf_core.robust.smoothing.Smoothed`."""
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
    walls = shadow_walls(sampled.samples, generator)
    seen = replace(sampled.samples[~walls], partial=bool(walls.any()))
    foreground = seen[~support(seen, generator)]
    if len(foreground) < _FEWEST:
        foreground = seen if len(seen) >= _FEWEST else sampled.samples
    return SceneView(
        sampled.frame, detection, foreground, sampled.spacing, float(walls.float().mean()), counted.evaluations
    )
