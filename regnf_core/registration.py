"""Registration of two fields. The preset `paper`, top to bottom: sample, initialise, refine, verify."""

from __future__ import annotations

import torch

from regnf_core.agreement import disagreement
from regnf_core.box import OrientedBox
from regnf_core.clouds import clouds_to_show
from regnf_core.extent import surface_extent
from regnf_core.fields.base import CountingField, SdfField
from regnf_core.initialisation import initial_transform
from regnf_core.optimisation import refine
from regnf_core.options import RegistrationOptions
from regnf_core.result import IterationRecord, ProgressCallback, RegistrationResult
from regnf_core.robust.register import register_robust
from regnf_core.run import STARTS, Run
from regnf_core.sampling import sample_object, sample_scene, thin_out
from regnf_core.shape import diameter
from regnf_core.sim3 import Sim3
from regnf_core.verification import verify

_SCORING_SAMPLES = 400
_SCORING_CAP = 0.1  # object diameters; a residual beyond it says no more than "wrong"


def register(
    scene: SdfField,
    obj: SdfField,
    detection: OrientedBox,
    options: RegistrationOptions | None = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    T_object_scene_start: Sim3 | None = None,
) -> RegistrationResult:
    """The similarity that carries the detected thing in the scene onto the library's object, and what supports it.

    ``progress`` is called with the phase and the overall share done (0..1), once an iteration while optimising; it may
    raise CancelledError. Deterministic for a seed, on one machine and with the same number of
    threads. What follows is the preset `paper`; the preset `robust` has an engine of its own, regnf_core.robust.
    ``T_object_scene_start``, for the preset `robust` alone, is where to look first; everything else is searched only if
    that fails.
    Raises InvalidDetectionError, NoSurfaceError, InitialisationError, InvalidInputError (FIELD_NOT_FINITE).
    """
    options = options or RegistrationOptions()
    if options.preset == "robust":
        return register_robust(scene, obj, detection, options, seed, progress, T_object_scene_start)
    run = Run(progress)
    scene, obj = CountingField(scene), CountingField(obj)
    generator = torch.Generator().manual_seed(seed)

    with run.phase("sampling"):
        scene_samples = sample_scene(scene, detection, options.sampling)
        run.report("sampling", 0.08)
        extent = surface_extent(obj)
        object_samples = sample_object(obj, options.sampling, extent=extent)
        object_diameter = diameter(object_samples.points)
        A = thin_out(scene_samples, options.resampling.max_samples, generator)
        B = thin_out(object_samples, options.resampling.max_samples, generator)

    with run.phase("initialising"):
        few_A, few_B = thin_out(A, _SCORING_SAMPLES, generator), thin_out(B, _SCORING_SAMPLES, generator)

        def score(T: Sim3) -> float:
            return disagreement(scene, obj, few_A.points, few_B.points, T, _SCORING_CAP * object_diameter)

        T_initial = initial_transform(scene_samples, object_samples, options.initialisation, seed, score)

    with run.phase("optimising"):

        def on_iteration(record: IterationRecord) -> None:
            span = STARTS["verifying"] - STARTS["optimising"]
            done = (record.iteration + 1) / options.optimisation.iterations
            run.report("optimising", STARTS["optimising"] + span * done)

        refined = refine(scene, obj, A, B, T_initial, options, generator, on_iteration)

    T = refined.T_object_scene
    with run.phase("verifying"):
        verification = verify(scene, obj, detection, extent, T, options.sampling, object_diameter)
    evaluations = scene.evaluations + obj.evaluations
    with run.phase("exporting"):
        samples = (scene_samples, object_samples)
        clouds = clouds_to_show((scene, obj), samples, detection, extent, T, options.sampling, seed)
    run.report("exporting", 1.0)
    return RegistrationResult(
        verdict=verification.verdict,
        verdict_reason=verification.reason,
        T_object_scene=T,
        T_object_scene_initial=T_initial,
        scene_samples=clouds.scene,
        object_samples=clouds.object,
        metrics={
            **verification.metrics,
            "object_diameter": object_diameter,
            "iterations": float(len(refined.trace)),
            "converged": float(refined.converged),
            "field_evaluations": float(evaluations),
            "field_evaluations_clouds": float(scene.evaluations + obj.evaluations - evaluations),
            **run.seconds,
        },
        trace=refined.trace,
        residuals=clouds.residuals,
        surroundings=clouds.surroundings,
        seed=seed,
        options=options.to_dict(),
    )
