"""The point clouds of a result, for pictures and viewers: dense where the object is, coarse round it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.agreement import object_residuals, scene_residuals
from regnf_core.box import OrientedBox
from regnf_core.context import surroundings
from regnf_core.densify import densify
from regnf_core.fields.base import SdfField
from regnf_core.options import SamplingOptions
from regnf_core.result import SurfaceSamples
from regnf_core.sampling import in_detection
from regnf_core.sim3 import Sim3

_DENSE = 10_000
_COARSE = 30_000


@dataclass(frozen=True)
class Clouds:
    """Scene within the detection and object, both dense, with their residuals; and the scene round the detection."""

    scene: SurfaceSamples
    object: SurfaceSamples
    surroundings: SurfaceSamples
    residuals: dict[str, Tensor]


def clouds_to_show(
    fields: tuple[SdfField, SdfField],
    samples: tuple[SurfaceSamples, SurfaceSamples],
    detection: OrientedBox,
    object_extent: OrientedBox,
    T_object_scene: Sim3,
    options: SamplingOptions,
    seed: int,
) -> Clouds:
    """Clouds for (scene, object) fields from the samples that were registered. Deterministic for a seed."""
    (scene, obj), (A, B) = fields, samples
    generator = torch.Generator().manual_seed(seed)
    dense_A = densify(scene, A, _DENSE, generator, lambda points: in_detection(points, detection, options))
    dense_B = densify(obj, B, _DENSE, generator, object_extent.contains)
    residuals = {
        "scene_points": dense_A.points,
        "scene_residuals": scene_residuals(scene, obj, dense_A.points, T_object_scene),
        "object_points": dense_B.points,
        "object_residuals": object_residuals(scene, obj, dense_B.points, T_object_scene),
    }
    return Clouds(dense_A, dense_B, surroundings(scene, detection, _COARSE, generator), residuals)
