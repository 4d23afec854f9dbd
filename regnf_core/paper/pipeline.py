"""The preset `paper`, top to bottom: sample, initialize, refine, verify."""

from __future__ import annotations

from collections.abc import Callable

import torch

from regnf_core.fields.base import SdfField
from regnf_core.fields.counting import CountingField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.shape import diameter
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.paper.initialization import initial_transform
from regnf_core.paper.optimization import refine
from regnf_core.paper.sampling import sample_object, sample_scene, thin_out
from regnf_core.paper.verification import verify
from regnf_core.result import IterationRecord, RegistrationResult, SurfaceSamples
from regnf_core.run import STARTS, Run
from regnf_core.surface.agreement import disagreement
from regnf_core.surface.extent import surface_extent

_SCORING_SAMPLES = 400
_SCORING_CAP = 0.1  # object diameters; a residual beyond it says no more than "wrong"


def register_paper(
    scene_field: SdfField,
    object_field: SdfField,
    detection: OrientedBox,
    options: RegistrationOptions,
    seed: int,
    run: Run,
) -> RegistrationResult:
    """T_object_scene by the published method; see docs/method.md.

    Raises InvalidDetectionError, NoSurfaceError, InitializationError, InvalidInputError (FIELD_NOT_FINITE).
    """
    scene, obj = CountingField(scene_field), CountingField(object_field)
    generator = torch.Generator().manual_seed(seed)

    with run.phase("sampling"):
        up_axis = options.up_axis or "z"
        scene_samples = sample_scene(scene, detection, options.sampling, up_axis=up_axis)
        run.report("sampling", 0.08)
        extent = surface_extent(obj)
        object_samples = sample_object(obj, options.sampling, extent=extent, up_axis=up_axis)
        object_diameter = diameter(object_samples.points)
        A = thin_out(scene_samples, options.resampling.max_samples, generator)
        B = thin_out(object_samples, options.resampling.max_samples, generator)

    with run.phase("initializing"):
        score = _disagreement_on_few(scene, obj, A, B, _SCORING_CAP * object_diameter, generator)
        T_initial = initial_transform(scene_samples, object_samples, options.initialization, seed, score)

    with run.phase("optimizing"):
        refined = refine(scene, obj, A, B, T_initial, options, generator, _on_iteration(options, run))

    with run.phase("verifying"):
        T = refined.T_object_scene
        verification = verify(scene, obj, detection, extent, T, options.sampling, object_diameter, up_axis)
    metrics = {
        **verification.metrics,
        "object_diameter": object_diameter,
        "iterations": float(len(refined.trace)),
        "converged": float(refined.converged),
        "field_evaluations": float(scene.evaluations + obj.evaluations),
    }
    return RegistrationResult(
        verdict=verification.verdict,
        verdict_reason=verification.reason,
        T_object_scene=T,
        T_object_scene_initial=T_initial,
        scene_samples=scene_samples,
        object_samples=object_samples,
        metrics=metrics,
        trace=refined.trace,
        residuals={},
        seed=seed,
        options=options.to_dict(),
    )


def _disagreement_on_few(
    scene: SdfField, obj: SdfField, A: SurfaceSamples, B: SurfaceSamples, cap: float, generator: torch.Generator
) -> Callable[[Sim3], float]:
    """How far the fields disagree under a transform, on a few samples of each: what chooses among RANSAC's draws."""
    few_A, few_B = thin_out(A, _SCORING_SAMPLES, generator), thin_out(B, _SCORING_SAMPLES, generator)
    return lambda T: disagreement(scene, obj, few_A.points, few_B.points, T, cap)


def _on_iteration(options: RegistrationOptions, run: Run) -> Callable[[IterationRecord], None]:
    span = STARTS["verifying"] - STARTS["optimizing"]
    return lambda record: run.report(
        "optimizing", STARTS["optimizing"] + span * (record.iteration + 1) / options.optimization.iterations
    )
