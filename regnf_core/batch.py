"""Several detections of one scene and several objects in one call. Shared data is computed once.

outcomes = register_batch(scene, [box_1, box_2], [chair, table], pairs=[(0, 0), (1, 1)])
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from regnf_core.document import Phase, ProgressCallback, RegistrationResult
from regnf_core.errors import CancelledError, RegnfError
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.options import RegistrationOptions
from regnf_core.pairs import pairs_of
from regnf_core.progress import Run
from regnf_core.robust.model import ObjectModel, model_object
from regnf_core.robust.pipeline import cloud_region, register_robust
from regnf_core.robust.scene import view_scene
from regnf_core.robust.working_frame import working_device
from regnf_core.surface.result_clouds import with_clouds

T = TypeVar("T")
Result = TypeVar("Result", bound=RegistrationResult)


@dataclass(frozen=True, eq=False)
class ModeledObject:
    """An object's field with its model from an earlier ``model_object``, so that it is not computed again."""

    field: SdfField
    model: ObjectModel


@dataclass(frozen=True)
class BatchOutcome(Generic[Result]):
    """The outcome of one pair of a batch: a result or an error. detection, object: their indices in the lists."""

    detection: int
    object: int
    result: Result | None
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
) -> list[BatchOutcome[RegistrationResult]]:
    """Register pairs of detection and object (given by index; None: all combinations) with the preset `robust`.

    Each result is that of :func:`regnf_core.register` for this pair and seed; a pair that fails does not stop the
    others. Without ``clouds`` no point clouds for viewers are made; they take about half of the time. ``progress`` gets
    the phases of one pair after the other, and the overall progress of all pairs. Raises InvalidOptionsError for
    options of another preset, InvalidInputError (PAIR_UNKNOWN) for a number beyond the lists, and CancelledError from
    ``progress``.
    """
    options = options or RegistrationOptions()
    options.require_robust("registers a batch")
    wanted, device = pairs_of(pairs, len(detections), len(objects)), working_device(scene)
    fields = [one.field if isinstance(one, ModeledObject) else one for one in objects]

    def modeled(number: int) -> ObjectModel:
        one = objects[number]
        return (one.model if isinstance(one, ModeledObject) else model_object(one, options.robust)).on(device)

    view_of = _once(lambda number: view_scene(scene, detections[number], options.robust).on(device))
    model_of = _once(modeled)
    outcomes = []
    for number, (d, o) in enumerate(wanted):
        run, box = Run(_share_of(progress, number, len(wanted))), detections[d]
        try:
            with run.phase("sampling"):
                view, model = view_of(d), model_of(o)
            result = register_robust(scene, fields[o], box, options, seed, run, None, model, view)
            if clouds:
                with run.phase("exporting"):
                    result = with_clouds(result, scene, fields[o], box, cloud_region(box))
            outcomes.append(BatchOutcome(d, o, run.finish(result)))
        except CancelledError:
            raise
        except RegnfError as error:
            outcomes.append(BatchOutcome[RegistrationResult](d, o, None, error))
    return outcomes


def _once(make: Callable[[int], T]) -> Callable[[int], T]:
    """``make``, called once for each number: what it gave or raised the first time, it gives or raises again."""
    made: dict[int, T | RegnfError] = {}

    def of(number: int) -> T:
        if number not in made:
            try:
                made[number] = make(number)
            except RegnfError as error:
                made[number] = error
        found = made[number]
        if isinstance(found, RegnfError):
            raise found
        return found

    return of


def _share_of(progress: ProgressCallback | None, number: int, count: int) -> ProgressCallback | None:
    """The progress of one pair as that of all ``count`` pairs."""
    if progress is None:
        return None

    def shared(phase: Phase, done: float) -> None:
        progress(phase, (number + done) / count)

    return shared
