"""Registration of two fields: the engine that the options name, then the clouds that show what it found."""

from __future__ import annotations

from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.paper.pipeline import register_paper
from regnf_core.result import ProgressCallback, RegistrationResult
from regnf_core.robust.model.object_model import ObjectModel
from regnf_core.robust.register import register_robust
from regnf_core.run import Run
from regnf_core.surface.clouds import with_clouds


def register(
    scene: SdfField,
    obj: SdfField,
    detection: OrientedBox,
    options: RegistrationOptions | None = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    T_object_scene_start: Sim3 | None = None,
    object_model: ObjectModel | None = None,
    clouds: bool = True,
) -> RegistrationResult:
    """The similarity that carries the detected thing in the scene onto the library's object, and what supports it.

    ``progress`` is called with the phase and the overall share done (0..1), once an iteration while optimizing; it may
    raise CancelledError. For the preset `robust` alone: ``T_object_scene_start`` is where to look first, anything else
    is searched only if that fails; ``object_model`` is what ``model_object`` made of ``obj``
    earlier. Without ``clouds`` the result has the engine's own samples alone, and neither residuals nor
    surroundings: for who draws no pictures.
    Deterministic for a seed, on one machine and with the same number of threads.
    Raises InvalidDetectionError, NoSurfaceError, InitializationError, InvalidInputError (FIELD_NOT_FINITE).
    """
    options = options or RegistrationOptions()
    run = Run(progress)
    if options.preset == "robust":
        result = register_robust(scene, obj, detection, options, seed, run, T_object_scene_start, object_model)
    else:
        result = register_paper(scene, obj, detection, options, seed, run)
    if clouds:
        with run.phase("exporting"):
            result = with_clouds(result, scene, obj, detection, options.sampling)
    run.report("exporting", 1.0)
    result.metrics.update(run.seconds)
    return result
