"""The point clouds of a result, for pictures and viewers: dense on the object, coarse around it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.fields.counting import CountingField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.result import RegistrationResult
from regnf_core.surface.field_residuals import object_residuals, scene_residuals
from regnf_core.surface.scene_surroundings import sample_surroundings
from regnf_core.surface.upsampling import upsample

_OBJECT_POINTS = 4_200
_SURROUNDING_POINTS = 5_500
_MARGIN = 0.02  # of the object's extent: how far beyond the samples new ones may lie


def with_clouds(
    result: RegistrationResult,
    scene_field: SdfField,
    object_field: SdfField,
    detection: OrientedBox,
    in_region: Callable[[Tensor], Tensor],
) -> RegistrationResult:
    """The result with more points in both clouds, the residuals there, and the scene around the detection.

    ``in_region`` tells which points (N, 3) of the scene may belong to the object's cloud, (N,) bool.
    The metric ``field_evaluations_clouds`` counts the evaluations for this; ``field_evaluations`` leaves them out.
    """
    scene, obj, T = CountingField(scene_field), CountingField(object_field), result.T_object_scene
    generator = torch.Generator().manual_seed(result.seed)
    extent = _extent(result.object_samples)
    A = upsample(scene, result.scene_samples, _OBJECT_POINTS, generator, in_region)
    B = upsample(obj, result.object_samples, _OBJECT_POINTS, generator, lambda points: extent.contains(points, _MARGIN))
    residuals = {
        "scene_points": A.points,
        "scene_residuals": scene_residuals(scene, obj, A.points, T),
        "object_points": B.points,
        "object_residuals": object_residuals(scene, obj, B.points, T),
    }
    around = sample_surroundings(scene, detection, _SURROUNDING_POINTS, generator)
    metrics = {**result.metrics, "field_evaluations_clouds": float(scene.evaluations + obj.evaluations)}
    return replace(result, scene_samples=A, object_samples=B, residuals=residuals, surroundings=around, metrics=metrics)


def _extent(samples: SurfaceSamples) -> OrientedBox:
    """The samples' axis-aligned box."""
    low, high = samples.points.amin(0).tolist(), samples.points.amax(0).tolist()
    return OrientedBox.from_corners(low, [max(b, a + 1e-9) for a, b in zip(low, high, strict=True)])
