"""``register`` and ``register_batch`` as users call them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import regnf_core.batch as engine_batch
import regnf_core.registration as engine
from regnf_core.api.fields import FieldLike, Opened, notes_of, opened, opened_pair, opened_several
from regnf_core.api.registered import Registered
from regnf_core.batch import ModeledObject
from regnf_core.detections.objects import BoxLike, detection_of
from regnf_core.errors import InvalidDetectionError, RegnfError
from regnf_core.field_files import require_file
from regnf_core.geometry.box import OrientedBox
from regnf_core.options import OptionsLike, options_of, seed_of
from regnf_core.pairs import pairs_of
from regnf_core.result import ProgressCallback
from regnf_core.robust.pipeline import WarmStart
from regnf_core.texts import json_value


@dataclass(frozen=True)
class BatchOutcome:
    """Of one pair of a batch: a result, or the error. detection, object: their numbers in the lists."""

    detection: int
    object: int
    result: Registered | None
    error: RegnfError | None = None


def register(
    scene: FieldLike,
    obj: FieldLike,
    detection: BoxLike,
    options: OptionsLike = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    warm_start: WarmStart | None = None,
    clouds: bool = True,
) -> Registered:
    """Find where a known object stands in a scanned scene: rotation, position and scale, with a verdict.

    scene, obj: fields, their paths, or meshes of trimesh or Open3D · detection: a box of regnf or Open3D, two corners,
    a detection's JSON, or the path of its file ·
    options: RegistrationOptions, or a dictionary of those that are not to have their defaults · progress: called with
    the phase and the overall share done, 0..1 · warm_start: a pose to try first, and the object's model · clouds: False
    saves time when nothing is drawn or saved.
    Deterministic for a seed, on one machine and with the same number of threads.
    Raises InvalidOptionsError, InvalidDetectionError, FieldFormatError, InvalidInputError (NO_FIELD, FILE_NOT_FOUND,
    FIELD_NOT_FINITE), NoSurfaceError, InitializationError.
    """
    chosen, box, seed = options_of(options), box_of(detection), seed_of(seed)
    place, thing = opened_pair(scene, obj)
    result = engine.register(place.field, thing.field, box, chosen, seed, progress, warm_start, clouds)
    return Registered.of(result, thing.name, notes_of(place, thing), box)


def register_batch(
    scene: FieldLike,
    detections: Sequence[BoxLike],
    objects: Sequence[FieldLike | ModeledObject],
    pairs: Sequence[tuple[int, int]] | None = None,
    options: OptionsLike = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    clouds: bool = True,
) -> list[BatchOutcome]:
    """Register pairs of detection and object, by their numbers (None: each with each), by the preset `robust`.

    What they share is made once; a pair that fails does not stop the others. Arguments as of ``register``.
    Raises InvalidOptionsError for options of another preset, InvalidInputError (PAIR_UNKNOWN, NO_FIELD).
    """
    chosen, boxes, seed = options_of(options), [box_of(one) for one in _several(detections)], seed_of(seed)
    pairs_of(pairs, len(boxes), len(objects))  # before any field is opened
    place = opened(scene, "scene")
    fields = [one if isinstance(one, ModeledObject) else opened_several([one], "object")[0] for one in objects]
    plain = [one.field if isinstance(one, Opened) else one for one in fields]
    found = engine_batch.register_batch(place.field, boxes, plain, pairs, chosen, seed, progress, clouds)
    return [_outcome(one, place, fields[one.object], boxes[one.detection]) for one in found]


def box_of(detection: BoxLike) -> OrientedBox:
    """The box that is meant. Raises InvalidDetectionError, and InvalidInputError (FILE_NOT_FOUND, MALFORMED_JSON)."""
    if isinstance(detection, str | os.PathLike):
        require_file(Path(detection))
        return OrientedBox.from_dict(json_value(Path(detection).read_bytes(), f"detection {detection}: "))
    return detection if isinstance(detection, OrientedBox) else OrientedBox.from_detection(detection_of(detection))


def _several(detections: Sequence[BoxLike]) -> Sequence[BoxLike]:
    if isinstance(detections, OrientedBox | str | os.PathLike) or not isinstance(detections, Sequence):
        raise InvalidDetectionError("the detections are one box, expected a list", hint="Write a list: [box].")
    return detections


def _outcome(
    one: engine_batch.BatchOutcome, scene: Opened, obj: Opened | ModeledObject, detection: OrientedBox
) -> BatchOutcome:
    if one.result is None:
        return BatchOutcome(one.detection, one.object, None, one.error)
    known = obj if isinstance(obj, Opened) else Opened(obj.field)
    result = Registered.of(one.result, known.name, notes_of(scene, known), detection)
    return BatchOutcome(one.detection, one.object, result)
