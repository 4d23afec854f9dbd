"""Several detections of one scene and several objects in one call: what they share is made once.

outcomes = register_batch(scene, [box_1, box_2], [chair, table], pairs=[(0, 0), (1, 1)])
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from regnf_core.document import Phase, ProgressCallback, RegistrationResult, Run
from regnf_core.errors import CancelledError, RegnfError
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.options import RegistrationOptions
from regnf_core.pairs import pairs_of
from regnf_core.robust.model import ObjectModel, model_object
from regnf_core.robust.pipeline import WarmStart, cloud_region, register_robust
from regnf_core.robust.scene import SceneView, view_scene
from regnf_core.robust.working_frame import working_device
from regnf_core.surface.result_clouds import with_clouds

_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class ModeledObject:
    """An object's field with its model, made earlier by ``model_object``: saves making it again."""

    field: SdfField
    model: ObjectModel


@dataclass(frozen=True)
class BatchOutcome:
    """A result, or the error that the registration of this pair raised."""

    detection: int
    object: int
    result: RegistrationResult | None
    error: RegnfError | None = None


def register_batch(
    scene: SdfField,
    detections: Sequence[OrientedBox],
    objects: Sequence[SdfField | ModeledObject],
    pairs: Sequence[tuple[int, int]] | None = None,
    options: RegistrationOptions | None = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    clouds: bool = True,
) -> list[BatchOutcome]:
    """Register pairs of detection and object (by number; None: each with each) by the preset `robust`.

    Each result is that of :func:`regnf_core.register` for this pair and seed; a pair that fails does not stop the
    others. Without ``clouds`` the point clouds for viewers are left out, which take about half of the time.
    ``progress`` gets the phases of one pair after the other, and the share done of all pairs.
    Raises InvalidOptionsError for options of another preset, InvalidInputError (PAIR_UNKNOWN) for a number beyond the
    lists, and CancelledError from ``progress``.
    """
    options = options or RegistrationOptions()
    options.require_robust("registers a batch")
    wanted = pairs_of(pairs, len(detections), len(objects))
    batch = _Batch(scene, detections, objects, options, seed)
    return [
        batch.one(d, o, Run(_share_of(progress, number, len(wanted))), clouds) for number, (d, o) in enumerate(wanted)
    ]


class _Batch:
    """Views and models, made when first needed. What failed once fails again without another attempt."""

    def __init__(
        self,
        scene: SdfField,
        detections: Sequence[OrientedBox],
        objects: Sequence[SdfField | ModeledObject],
        options: RegistrationOptions,
        seed: int,
    ) -> None:
        self.scene, self.detections, self.options, self.seed = scene, detections, options, seed
        self.objects = [one.field if isinstance(one, ModeledObject) else one for one in objects]
        models = {number: one.model for number, one in enumerate(objects) if isinstance(one, ModeledObject)}
        self._views: dict[int, SceneView | RegnfError] = {}
        self._given: dict[int, ObjectModel | RegnfError] = dict(models)
        self._models: dict[int, ObjectModel] = {}

    def one(self, d: int, o: int, run: Run, clouds: bool) -> BatchOutcome:
        """Of one pair."""
        return _outcome(d, o, lambda: self._register(d, o, run, clouds))

    def _register(self, d: int, o: int, run: Run, clouds: bool) -> RegistrationResult:
        with run.phase("sampling"):
            view, model = self._view(d), self._model(o)
        result = register_robust(
            self.scene,
            self.objects[o],
            self.detections[d],
            self.options,
            self.seed,
            run,
            WarmStart(object_model=model),
            view,
        )
        return run.finish(result, (lambda found: self._with_clouds(d, o, found)) if clouds else None)

    def _with_clouds(self, d: int, o: int, found: RegistrationResult) -> RegistrationResult:
        box = self.detections[d]
        return with_clouds(found, self.scene, self.objects[o], box, cloud_region(box))

    def _view(self, d: int) -> SceneView:
        return _once(self._views, d, lambda: self._seen(self.detections[d]))

    def _seen(self, detection: OrientedBox) -> SceneView:
        """On the device that the work is done on."""
        view = view_scene(self.scene, detection, self.options.robust)
        return view.to(working_device(self.scene))

    def _model(self, o: int) -> ObjectModel:
        """On the same device."""
        if o not in self._models:
            made = _once(self._given, o, lambda: model_object(self.objects[o], self.options.robust))
            self._models[o] = made.to(working_device(self.scene))
        return self._models[o]


def _once(made: dict[int, _T | RegnfError], key: int, make: Callable[[], _T]) -> _T:
    """What ``make`` gave or raised the first time."""
    if key not in made:
        try:
            made[key] = make()
        except RegnfError as error:
            made[key] = error
    found = made[key]
    if isinstance(found, RegnfError):
        raise found
    return found


def _outcome(d: int, o: int, make: Callable[[], RegistrationResult]) -> BatchOutcome:
    """The result that is made, or the error. Raises CancelledError."""
    try:
        return BatchOutcome(d, o, make())
    except CancelledError:
        raise
    except RegnfError as error:
        return BatchOutcome(d, o, None, error)


def _share_of(progress: ProgressCallback | None, number: int, count: int) -> ProgressCallback | None:
    """The progress of one pair as that of all ``count`` pairs."""
    if progress is None:
        return None

    def shared(phase: Phase, done: float) -> None:
        progress(phase, (number + done) / count)

    return shared
