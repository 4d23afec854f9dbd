"""The verdict: do the two fields agree on points that the optimizer has never seen? Ours; the paper has none.

A registration is accepted when, on fresh samples of both surfaces, most residuals S_object(T x) - s S_scene(x) are
small against the object's diameter, in both directions, and their size overall is small too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.errors import NoSurfaceError
from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import Axis, SamplingOptions
from regnf_core.paper.sampling import sample_object, sample_scene
from regnf_core.result import Verdict
from regnf_core.surface.field_residuals import object_residuals, scene_residuals

INLIER_DISTANCE = 0.015
"""Largest |residual| of an inlier, object diameters."""
MIN_INLIER_SHARE = 0.8
"""Least share of inliers in each direction; under it: LOW_OVERLAP. On exact fields right registrations reach 0.99 or
more, errors of 6 % of the diameter at most 0.7, another chair at most 0.65."""
MAX_RESIDUAL_RMS = 0.03
"""Largest root mean square of all residuals, object diameters; above it: LARGE_RESIDUAL."""
_STRIDE_FACTOR = 2  # a quarter of the rays of the first sampling is plenty for shares


@dataclass(frozen=True)
class Verification:
    """The verdict with its reason (a stable UPPER_SNAKE word) and the numbers behind it."""

    verdict: Verdict
    reason: str
    metrics: dict[str, float]


def verify(
    scene: SdfField,
    obj: SdfField,
    detection: OrientedBox,
    object_extent: OrientedBox,
    T_object_scene: Sim3,
    options: SamplingOptions,
    object_diameter: float,
    up_axis: Axis = "z",
) -> Verification:
    """The verdict on the transform, from fresh samples of both surfaces, seen by cameras between the first ones."""
    turn = math.pi / options.views
    scene_points = _fresh_points(lambda chosen: sample_scene(scene, detection, chosen, turn, up_axis), options)
    object_points = _fresh_points(lambda chosen: sample_object(obj, chosen, turn, object_extent, up_axis), options)
    scene_to_object = scene_residuals(scene, obj, scene_points, T_object_scene) / object_diameter
    object_to_scene = object_residuals(scene, obj, object_points, T_object_scene) / object_diameter
    return evaluate(scene_to_object, object_to_scene)


def _fresh_points(sample: Callable[[SamplingOptions], SurfaceSamples], options: SamplingOptions) -> Tensor:
    """(N, 3) points by ``sample`` with fewer rays than ``options`` names; with more rays where these find too few.

    Raises NoSurfaceError when even four times the rays of the first sampling find too few.
    """
    stride = min(options.pixel_stride * _STRIDE_FACTOR, options.image_size)
    while True:
        try:
            return sample(replace(options, pixel_stride=stride)).points
        except NoSurfaceError:
            if stride == 1 or stride * _STRIDE_FACTOR <= options.pixel_stride:
                raise
        stride = max(1, stride // _STRIDE_FACTOR)


def evaluate(scene_to_object: Tensor, object_to_scene: Tensor) -> Verification:
    """The verdict for signed residuals (N,) at scene points and (M,) at object points, in object diameters."""
    share_scene, share_object = _inlier_share(scene_to_object), _inlier_share(object_to_scene)
    rms = float(torch.cat([scene_to_object, object_to_scene.to(scene_to_object)]).double().square().mean().sqrt())
    metrics = {
        "residual_rms": rms,
        "inlier_share_scene": share_scene,
        "inlier_share_object": share_object,
        "free_space_violations": float((object_to_scene > INLIER_DISTANCE).double().mean()),
    }
    # Written so that a residual that is not a number can only lead to a rejection.
    if not min(share_scene, share_object) >= MIN_INLIER_SHARE:
        return Verification("rejected", "LOW_OVERLAP", metrics)
    if not rms <= MAX_RESIDUAL_RMS:
        return Verification("rejected", "LARGE_RESIDUAL", metrics)
    return Verification("registered", "SURFACES_AGREE", metrics)


def _inlier_share(residuals: Tensor) -> float:
    return float((residuals.abs() <= INLIER_DISTANCE).double().mean())
