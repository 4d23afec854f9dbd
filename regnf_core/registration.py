"""Registration of two fields: by the preset that the options name, then the point clouds of the result."""

from __future__ import annotations

from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.options import RegistrationOptions
from regnf_core.paper import pipeline as paper
from regnf_core.result import ProgressCallback, RegistrationResult
from regnf_core.robust.pipeline import WarmStart, cloud_region, register_robust
from regnf_core.run import Run
from regnf_core.surface.result_clouds import with_clouds

__all__ = ["WarmStart", "register", "with_late_clouds"]


def register(
    scene: SdfField,
    obj: SdfField,
    detection: OrientedBox,
    options: RegistrationOptions | None = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    warm_start: WarmStart | None = None,
    clouds: bool = True,
) -> RegistrationResult:
    """Find where a known object stands in a scanned scene: rotation, position and scale, with a verdict.

    ``progress`` is called with the phase and the overall share done (0..1), once an iteration while optimizing; it may
    raise CancelledError. ``warm_start``, for the preset `robust` alone: a pose to try first, and the object's model.
    Without ``clouds`` the result holds only the samples that the registration used, and neither residuals nor
    surroundings; this saves time when no pictures are drawn.
    Deterministic for a seed, on one machine and with the same number of threads.
    Raises InvalidDetectionError, NoSurfaceError, InitializationError, InvalidInputError (FIELD_NOT_FINITE), and
    InvalidOptionsError (INITIAL_TRANSFORM_UNSUPPORTED, INVALID_OPTIONS) for a warm start under another preset.
    """
    options = options or RegistrationOptions()
    if warm_start is not None:
        _check_warm_start(warm_start, options)
    run = Run(progress)
    if options.preset == "robust":
        result = register_robust(scene, obj, detection, options, seed, run, warm_start)
    else:
        result = paper.register_paper(scene, obj, detection, options, seed, run)
    return run.finish(
        result, (lambda found: with_late_clouds(found, scene, obj, detection, options)) if clouds else None
    )


def with_late_clouds(
    result: RegistrationResult, scene: SdfField, obj: SdfField, detection: OrientedBox, options: RegistrationOptions
) -> RegistrationResult:
    """The result of ``register`` without clouds as it returns it with them, but for the seconds of this phase."""
    region = cloud_region(detection) if options.preset == "robust" else paper.cloud_region(detection, options)
    return with_clouds(result, scene, obj, detection, region)


def _check_warm_start(warm_start: WarmStart, options: RegistrationOptions) -> None:
    if warm_start.T_object_scene is not None:
        options.require_robust("starts from a given transform", reason="INITIAL_TRANSFORM_UNSUPPORTED")
    if warm_start.object_model is not None:
        options.require_robust("uses an object model")
