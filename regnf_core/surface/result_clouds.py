"""The point clouds of a result, for pictures and viewers: dense on the object, coarse around it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.document import RegistrationResult
from regnf_core.fields.observation import CountingField, SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.metrics import gaps
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples

# Residuals between two fields under a transform. Unlike those of the published loss, they keep the scale.
#
# Under x_object = T x the two fields describe one surface when S_object(T x) = s S_scene(x).


def scene_residuals(scene: SdfField, obj: SdfField, points: Tensor, T_object_scene: Sim3) -> Tensor:
    """S_object(T x) - s S_scene(x) (N,), object units, at points x (N, 3) of the scene frame."""
    moved = obj.signed_distance(T_object_scene.apply(points)).to(points)
    return moved - float(T_object_scene.scale) * scene.signed_distance(points).to(points)


def object_residuals(scene: SdfField, obj: SdfField, points: Tensor, T_object_scene: Sim3) -> Tensor:
    """s S_scene(T^-1 z) - S_object(z) (N,), object units, at points z (N, 3) of the object frame.

    Positive: the scene is free where the object should be. Negative: the scene holds more matter there.
    """
    moved = scene.signed_distance(T_object_scene.apply_inverse(points)).to(points)
    return float(T_object_scene.scale) * moved - obj.signed_distance(points).to(points)


def mean_residual(
    scene: SdfField, obj: SdfField, scene_points: Tensor, object_points: Tensor, T_object_scene: Sim3, cap: float
) -> float:
    """Mean |residual| of both directions, each at most ``cap`` (object units): a score, smaller is better."""
    scene_to_object = scene_residuals(scene, obj, scene_points, T_object_scene).abs()
    object_to_scene = object_residuals(scene, obj, object_points, T_object_scene).abs()
    return float(torch.cat([scene_to_object, object_to_scene.to(scene_to_object)]).clamp_max(cap).mean())


# Points moved onto a field's zero level by Newton's method along the gradient.
#
# A step subtracts S g / |g|^2, with S the signed distance and g its gradient at the point. Where the gradient is
# short, the step is long and wrong. So |g| counts as ``min_slope`` at least. Four values are in use:
#
#     0.5     MIN_SLOPE: clouds for viewers, an object's bounds
#     0.2     samples for registration (robust/constants.py); shorter gradients are dropped there
#     0.001   the surface beneath a sample (robust/constants.py): only a gradient of zero is left out
#     1e-6    the importer, which bounds the steps' length as well

MIN_SLOPE = 0.5
"""Least |g| that is trusted. The gradient of an exact distance has length 1."""

DistanceAndGradient = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Signed distance (N,) and gradient (N, 3) at points (N, 3), for instance ``field.signed_distance_and_gradient``."""


@dataclass(frozen=True, eq=False)
class ProjectedPoints:
    """Where the steps end: points (N, 3), and the field's distance (N,) and gradient (N, 3) there, in one dtype."""

    points: Tensor
    distance: Tensor
    gradient: Tensor


def newton_step(distance: Tensor, gradient: Tensor, min_slope: float = MIN_SLOPE) -> Tensor:
    """(N, 3), what to subtract from points with this distance (N,) and gradient (N, 3) to come to the zero level."""
    length = distance / gradient.square().sum(-1).clamp_min(min_slope**2)
    return length.unsqueeze(-1) * gradient


def project_to_surface(
    evaluate: DistanceAndGradient, points: Tensor, steps: int, min_slope: float = MIN_SLOPE
) -> ProjectedPoints:
    """The points (N, 3) after ``steps`` Newton steps. Evaluates the field ``steps`` + 1 times at each point.

    Nothing is dropped: the caller decides by ``distance`` which points have arrived.
    """
    for _ in range(steps):
        distance, gradient = evaluate(points)
        points = points - newton_step(distance.to(points), gradient.to(points), min_slope)
    distance, gradient = evaluate(points)
    return ProjectedPoints(points, distance.to(points), gradient.to(points))


# More surface points between those already found, for pictures and viewers. Cheaper than casting more rays.

_MAX_SHIFT = 1.5  # gaps between a new point and the old one that it starts from
_MAX_GAP = 4.0  # typical gaps; else an isolated stray point would receive most of the new points
_UPSAMPLING_STEPS = 1  # new points start within a gap of the surface
_TOLERANCE_SHARE = 0.05  # of a typical gap: largest |S| at a new point


def upsample(
    field: SdfField, samples: SurfaceSamples, count: int, generator: torch.Generator, inside: Callable[[Tensor], Tensor]
) -> SurfaceSamples:
    """The samples and new ones, about ``count`` in all: old points shifted along the surface, then projected onto it.

    ``inside`` tells which new points (N, 3) are kept, (N,) bool. Same frame and unit as the samples.
    """
    missing = count - samples.points.shape[0]
    if missing <= 0:
        return samples
    local = gaps(samples.points).cpu()
    gap = float(local.median())
    local = local.clamp_max(_MAX_GAP * gap)
    # In proportion to the area around a point, so that sparsely sampled parts are filled first.
    seeds = torch.multinomial(local.square() + 1e-12, missing, replacement=True, generator=generator)
    shift = _MAX_SHIFT * local[seeds].unsqueeze(-1) * (2.0 * torch.rand(missing, 3, generator=generator) - 1.0)
    seeds, shift = seeds.to(samples.points.device), shift.to(samples.points)
    normals = samples.normals[seeds]
    points = samples.points[seeds] + shift - (shift * normals).sum(-1, keepdim=True) * normals
    found = project_to_surface(field.signed_distance_and_gradient, points, _UPSAMPLING_STEPS)
    kept = (found.distance.abs() <= _TOLERANCE_SHARE * gap) & inside(found.points)
    unit = torch.nn.functional.normalize(found.gradient, dim=-1)
    return SurfaceSamples.cat([samples, SurfaceSamples(found.points[kept], unit[kept])])


# Points of the scene's surface around the detection, for pictures and viewers.

_SEED_SHARE = 0.2
_NEWTON_STEPS = 3
_TOLERANCE = 1e-3  # of the bounds' diagonal: largest |S| at a point that is kept


def sample_surroundings(
    scene: SdfField, detection: OrientedBox, count: int, generator: torch.Generator
) -> SurfaceSamples:
    """About ``count`` points of the scene's surface outside the detection box, scene frame, with unit normals.

    Random points of the bounds are projected onto the surface. Those that do not arrive are dropped, and the gaps
    between the others are filled. This is far cheaper than rays from many views.
    """
    low, high = scene.bounds

    def in_surroundings(points: Tensor) -> Tensor:
        within: Tensor = ((points >= low.to(points)) & (points <= high.to(points))).all(-1)
        return within & ~detection.contains(points)

    points = (low + (high - low) * torch.rand(int(_SEED_SHARE * count), 3, generator=generator)).to(scene.device)
    found = project_to_surface(scene.signed_distance_and_gradient, points, _NEWTON_STEPS)
    kept = (found.distance.abs() <= _TOLERANCE * float((high - low).norm())) & in_surroundings(found.points)
    normals = torch.nn.functional.normalize(found.gradient[kept], dim=-1)
    seeds = SurfaceSamples(found.points[kept], normals)
    return upsample(scene, seeds, count, generator, in_surroundings) if len(seeds.points) else seeds


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
    low, high = result.object_samples.points.amin(0).tolist(), result.object_samples.points.amax(0).tolist()
    extent = OrientedBox.from_corners(low, [max(b, a + 1e-9) for a, b in zip(low, high, strict=True)])
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
