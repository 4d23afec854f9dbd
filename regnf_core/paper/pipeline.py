"""The preset `paper`: the method of Reg-NF in the paper's own order. docs/method.md follows the same numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.fields.counting import CountingField
from regnf_core.fields.transformed import near_origin
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.points import diameter
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import Axis, RegistrationOptions
from regnf_core.paper.initialization import initial_transform
from regnf_core.paper.optimization import Refinement, refine
from regnf_core.paper.sampling import in_detection, sample_object, sample_scene
from regnf_core.paper.verification import Verification, verify
from regnf_core.result import IterationRecord, RegistrationResult
from regnf_core.run import STARTS, Run
from regnf_core.surface.field_residuals import mean_residual
from regnf_core.surface.surface_bounds import surface_bounds

_SCORING_SAMPLES = 400
_MAX_SCORING_RESIDUAL = 0.1  # object diameters; a residual beyond it says no more than "wrong"


@dataclass(frozen=True, eq=False)
class _Surfaces:
    """Surface points of both fields, each in its own frame; the object's bounding box and diameter, object frame."""

    scene: SurfaceSamples
    object: SurfaceSamples
    object_bounds: OrientedBox
    object_diameter: float


def register_paper(
    scene_field: SdfField,
    object_field: SdfField,
    detection: OrientedBox,
    options: RegistrationOptions,
    seed: int,
    run: Run,
) -> RegistrationResult:
    """T_object_scene by the published method.

    Raises InvalidDetectionError, NoSurfaceError, InitializationError, InvalidInputError (FIELD_NOT_FINITE).
    """
    # Rays and samples are float32: fields far from the origin are moved there, and the result back.
    scene_field, scene_origin = near_origin(scene_field)
    object_field, object_origin = near_origin(object_field)
    detection = replace(detection, center=detection.center - scene_origin)
    scene, obj = CountingField(scene_field), CountingField(object_field)
    generator = torch.Generator().manual_seed(seed)

    # 1. Surface points of scene and object, as virtual cameras see them (section III-C.1).
    with run.phase("sampling"):
        surfaces = _sample(scene, obj, detection, options, run)
        A = surfaces.scene.subsample(options.resampling.max_samples, generator)
        B = surfaces.object.subsample(options.resampling.max_samples, generator)

    # 2. Initial transform from feature matches and ICP, scale 1 (section III-C.2).
    with run.phase("initializing"):
        score = _scoring(scene, obj, A, B, _MAX_SCORING_RESIDUAL * surfaces.object_diameter, generator)
        T_initial = initial_transform(surfaces.scene, surfaces.object, options.initialization, seed, score)

    # 3. to 6. Loss, robust kernel, optimizer and resampling (sections III-C to III-E, Algorithm 1).
    with run.phase("optimizing"):
        refined = refine(scene, obj, A, B, T_initial, options, generator, _on_iteration(options, run))

    # 7. Verdict on fresh surface points. Ours: the paper has none.
    with run.phase("verifying"):
        verification = _verify(scene, obj, detection, surfaces, refined.T_object_scene, options)

    evaluations = scene.evaluations + obj.evaluations
    found = _result(surfaces, T_initial, refined, verification, options, seed, evaluations)
    return _moved_back(found, scene_origin, object_origin)


def _moved_back(result: RegistrationResult, scene_origin: Tensor, object_origin: Tensor) -> RegistrationResult:
    """The result in the frames from whose places these were subtracted."""
    if not (bool(scene_origin.any()) or bool(object_origin.any())):
        return result

    def back(T: Sim3) -> Sim3:
        return Sim3.from_translation(object_origin) @ T @ Sim3.from_translation(-scene_origin)

    scene, obj = result.scene_samples, result.object_samples
    return replace(
        result,
        T_object_scene=back(result.T_object_scene),
        T_object_scene_initial=back(result.T_object_scene_initial),
        scene_samples=SurfaceSamples(scene.points.double().cpu() + scene_origin, scene.normals),
        object_samples=SurfaceSamples(obj.points.double().cpu() + object_origin, obj.normals),
        trace=[replace(one, T_object_scene=back(one.T_object_scene)) for one in result.trace],
    )


def cloud_region(detection: OrientedBox, options: RegistrationOptions) -> Callable[[Tensor], Tensor]:
    """Tells which points (N, 3) of the scene may belong to a result's clouds, (N,) bool: those that step 1 keeps."""
    return lambda points: in_detection(points, detection, options.sampling, _up_axis(options))


def _sample(
    scene: SdfField, obj: SdfField, detection: OrientedBox, options: RegistrationOptions, run: Run
) -> _Surfaces:
    up_axis = _up_axis(options)
    scene_samples = sample_scene(scene, detection, options.sampling, up_axis=up_axis)
    run.report("sampling", 0.08)
    object_bounds = surface_bounds(obj)
    object_samples = sample_object(obj, options.sampling, extent=object_bounds, up_axis=up_axis)
    return _Surfaces(scene_samples, object_samples, object_bounds, diameter(object_samples.points))


def _verify(
    scene: SdfField,
    obj: SdfField,
    detection: OrientedBox,
    surfaces: _Surfaces,
    T_object_scene: Sim3,
    options: RegistrationOptions,
) -> Verification:
    bounds, size = surfaces.object_bounds, surfaces.object_diameter
    return verify(scene, obj, detection, bounds, T_object_scene, options.sampling, size, _up_axis(options))


def _result(
    surfaces: _Surfaces,
    T_initial: Sim3,
    refined: Refinement,
    verification: Verification,
    options: RegistrationOptions,
    seed: int,
    evaluations: int,
) -> RegistrationResult:
    return RegistrationResult(
        verdict=verification.verdict,
        verdict_reason=verification.reason,
        T_object_scene=refined.T_object_scene,
        T_object_scene_initial=T_initial,
        scene_samples=surfaces.scene,
        object_samples=surfaces.object,
        metrics={
            **verification.metrics,
            "object_diameter": surfaces.object_diameter,
            "iterations": float(len(refined.trace)),
            "converged": float(refined.converged),
            "field_evaluations": float(evaluations),
        },
        trace=refined.trace,
        residuals={},
        seed=seed,
        options=options.to_dict(),
        center_object=surfaces.object.points.double().mean(0).cpu(),
    )


def _up_axis(options: RegistrationOptions) -> Axis:
    return options.up_axis or "z"


def _scoring(
    scene: SdfField, obj: SdfField, A: SurfaceSamples, B: SurfaceSamples, cap: float, generator: torch.Generator
) -> Callable[[Sim3], float]:
    """The mean residual under a transform on a few samples of each field: what chooses among RANSAC's draws."""
    few_A, few_B = A.subsample(_SCORING_SAMPLES, generator), B.subsample(_SCORING_SAMPLES, generator)
    return lambda T: mean_residual(scene, obj, few_A.points, few_B.points, T, cap)


def _on_iteration(options: RegistrationOptions, run: Run) -> Callable[[IterationRecord], None]:
    span = STARTS["verifying"] - STARTS["optimizing"]
    return lambda record: run.report(
        "optimizing", STARTS["optimizing"] + span * (record.iteration + 1) / options.optimization.iterations
    )
