"""What one detection shows of a scene: sampled once, matched against as many objects as one likes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch

from regnf_core.box import OrientedBox
from regnf_core.fields.base import SdfField
from regnf_core.options import RobustOptions
from regnf_core.robust.frame import WorkingField, WorkingFrame
from regnf_core.robust.proxy import ProxyField, proxy_of
from regnf_core.robust.residuals import Samples
from regnf_core.robust.samples import sample_scene_surface
from regnf_core.robust.support import support

_FEWEST = 30  # samples in front of the supports; with fewer, the supports are kept after all


@dataclass(frozen=True, eq=False)
class SceneView:
    """The surface in the detection box. Working frame: the box's centre at 0, its diagonal 1.

    foreground: the samples that stand in front of floors and walls · spacing: between samples.
    """

    field: WorkingField
    frame: WorkingFrame
    detection: OrientedBox
    foreground: Samples
    spacing: float

    @cached_property
    def proxy(self) -> ProxyField:
        """The distance table made from the foreground."""
        return proxy_of(self.foreground, self.spacing)


def view_scene(
    scene: SdfField, detection: OrientedBox, options: RobustOptions, generator: torch.Generator
) -> SceneView:
    """Sample the scene's surface in the box and set floors and walls aside.

    Raises InvalidDetectionError (DETECTION_OUTSIDE_SCENE), NoSurfaceError (NO_SURFACE_IN_DETECTION),
    InvalidInputError (FIELD_NOT_FINITE).
    """
    sampled = sample_scene_surface(scene, detection, options.scene_samples, generator)
    foreground = sampled.samples[~support(sampled.samples, generator)]
    if len(foreground) < _FEWEST:
        foreground = sampled.samples
    return SceneView(sampled.field, sampled.frame, detection, foreground, sampled.spacing)
