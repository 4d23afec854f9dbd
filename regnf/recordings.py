"""``register``, ``search`` and ``register_batch``, for scenes that are fields or depth images.

frame = regnf.Frame(depth, K, mask=mask, color=color)
result = regnf.register(frame, "chair.stl", options={"robust": {"object_unit": "mm"}})
print(result.verdict, result.T_camera_object)
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

import regnf_core.api as core
from regnf_core.api import FieldLike, Objects, Registered, Search
from regnf_core.batch import BatchOutcome, ModeledObject
from regnf_core.detections.images import (
    AnyDetection,
    ImageDetection,
    image_detection_in_field,
    is_image_detection,
    read_detection,
)
from regnf_core.detections.parsing import BoxLike
from regnf_core.document import ProgressCallback
from regnf_core.errors import InvalidDetectionError, RegnfError
from regnf_core.field_files import require_file
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import OptionsLike, options_of
from regnf_core.pairs import pairs_of
from regnf_core.robust.model import ObjectModel, model_object
from regnf_core.texts import json_value
from regnf_data.recordings.opening import is_recording, open_recording
from regnf_data.recordings.recording import Recording
from regnf_data.recordings.stored import frame_of_arrays, recording_of_frames
from regnf_fit.images.recorded_scene import RecordedScene, recorded_scene


@dataclass(frozen=True, eq=False)
class Frame:
    """A depth image in memory with its camera, as from a driver or a dataset.

    depth: (H, W), meters along the camera's axis; or whole numbers of ``depth_unit`` meters, by default millimeters; 0
    and NaN are no measurement · K: (3, 3) or fx, fy, cx, cy, pixels of the depth image, centers at whole numbers as
    OpenCV has them · color: (H', W', 3) uint8, taken by the same camera · mask: (H', W') of the color's or the depth's
    size, true on the object: the detection, unless another one is given · T_world_camera: (4, 4), camera to world, x
    right, y down, z forward; None: the camera frame is the world · name: the name of the frame in detections and
    results.
    """

    depth: Any
    K: Any
    mask: Any = None
    color: Any = None
    depth_unit: float | None = None
    T_world_camera: Any = None
    name: str = "0"


SceneLike = FieldLike | Frame | Sequence[Frame] | Recording
"""A field, or depth images: in memory, or the path of a recording (docs/datasets.md)."""
DetectionLike = BoxLike | ImageDetection | Sequence[ImageDetection] | None
"""A box in the scene's frame. For depth images also a mask, box or point in one of them. None: the masks of the
frames."""


def register(
    scene: SceneLike,
    obj: FieldLike,
    detection: DetectionLike = None,
    options: OptionsLike = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    initial_transform: Sim3 | ArrayLike | None = None,
    object_model: ObjectModel | None = None,
    clouds: bool = True,
) -> Registered:
    """Find the pose of a known object in a scene (a field or depth images): rotation, position, scale and a verdict.

    See :func:`regnf_core.register` for the arguments. For depth images the result also has ``camera``,
    ``T_camera_object`` and the picture ``overlay``. The object's unit follows from its size, unless the option
    ``robust.object_unit`` gives it. Raises the errors of that function, DatasetError, and InvalidDetectionError with
    the name of the frame.
    """
    recording = _recording(scene)
    more = {"progress": progress, "initial_transform": initial_transform, "clouds": clouds}
    if recording is None:
        return core.register(scene, obj, _box(detection), options, seed, object_model=object_model, **more)  # type: ignore[arg-type]
    chosen, thing = options_of(options), core.opened(obj, "object")
    model = object_model or model_object(thing.field, chosen.robust)
    place = recorded_scene(recording, _detection(scene, detection), model.bounds.numpy(), chosen)
    found = core.register(place.field, thing.field, place.box, place.options, seed, object_model=model, **more)  # type: ignore[arg-type]
    notes = None if thing.notes is None else {"object": thing.notes}
    return _seen(replace(found, object_name=thing.name, notes=notes), place, thing.field if clouds else None)


def search(
    scene: SceneLike,
    objects: Objects,
    detection: DetectionLike = None,
    options: OptionsLike = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    clouds: bool = True,
) -> Search:
    """Find which object is in the box, and its pose: :func:`regnf_core.search`. Scenes and detections as in
    ``register``."""
    recording = _recording(scene)
    if recording is None:
        return core.search(scene, objects, _box(detection), options, seed, progress, clouds)  # type: ignore[arg-type]
    place = recorded_scene(recording, _detection(scene, detection), None, options_of(options))
    found = core.search(place.field, objects, place.box, place.options, seed, progress, clouds)
    return replace(found, result=_seen(found.result, place))


def register_batch(
    scene: SceneLike,
    detections: Sequence[Any],
    objects: Sequence[FieldLike | ModeledObject],
    pairs: Sequence[tuple[int, int]] | None = None,
    options: OptionsLike = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    clouds: bool = True,
) -> list[BatchOutcome[Registered]]:
    """Register pairs of detection and object: :func:`regnf_core.register_batch`. Scenes and detections as in
    ``register``. For depth images ``progress`` is called for one pair after the other."""
    recording = _recording(scene)
    if recording is None:
        return core.register_batch(scene, detections, objects, pairs, options, seed, progress, clouds)  # type: ignore[arg-type]
    outcomes = []
    chosen = options_of(options)
    modeled = [one if isinstance(one, ModeledObject) else _modeled(core.opened(one, "object").field) for one in objects]
    for d, o in pairs_of(pairs, len(detections), len(objects)):
        try:
            where = _detection(scene, detections[d])
            place = recorded_scene(recording, where, modeled[o].model.bounds.numpy(), chosen)
        except RegnfError as error:
            outcomes.append(BatchOutcome[Registered](d, o, None, error))
            continue
        (one,) = core.register_batch(
            place.field, [place.box], [modeled[o]], None, place.options, seed, progress, clouds
        )
        result = None if one.result is None else _seen(one.result, place)
        outcomes.append(BatchOutcome(d, o, result, one.error))
    return outcomes


def _modeled(field: SdfField) -> ModeledObject:
    return ModeledObject(field, model_object(field))


def _seen(found: Registered, place: RecordedScene, obj: SdfField | None = None) -> Registered:
    """With the camera; and with the picture, where the object is given."""
    result = replace(found, camera=place.camera, detection=place.box)
    if obj is None:
        return result
    from regnf_fit.images.overlay import object_mesh, overlay_picture

    return replace(result, overlay=overlay_picture(result, place.frame, *object_mesh(obj)))


def _recording(scene: SceneLike) -> Recording | None:
    """The depth images that are meant; None for a field."""
    if isinstance(scene, Recording):
        return scene
    if isinstance(scene, str | os.PathLike):
        return open_recording(scene) if is_recording(Path(scene)) else None
    frames = _frames(scene)
    if not frames:
        return None
    held = [frame_of_arrays(f.depth, f.K, f.color, f.depth_unit, f.T_world_camera, f.name) for f in frames]
    names = [frame.name for frame in held]
    if len(set(names)) < len(names):
        held = [replace(frame, name=str(number)) for number, frame in enumerate(held)]
    return recording_of_frames(held)


def _frames(scene: Any) -> list[Frame]:
    frames = [scene] if isinstance(scene, Frame) else scene if isinstance(scene, list | tuple) else []
    return list(frames) if all(isinstance(one, Frame) for one in frames) else []


def _detection(scene: Any, given: Any) -> OrientedBox | Sequence[ImageDetection]:
    """The detection in depth images. Raises InvalidDetectionError."""
    if given is None:
        frames = _frames(scene)
        masks = [ImageDetection(number, np.asarray(f.mask)) for number, f in enumerate(frames) if f.mask is not None]
        if not masks:
            raise InvalidDetectionError("no detection is given, and no frame has a mask")
        return masks
    if isinstance(given, ImageDetection):
        return (given,)
    folder = None
    if isinstance(given, str | os.PathLike):
        folder = Path(given).parent
        require_file(Path(given))
        given = json_value(Path(given).read_bytes(), f"detection {given}: ")
    if is_image_detection(given):
        found: AnyDetection = read_detection(given, None, folder)
        assert isinstance(found, tuple)
        return found
    return core.box_of(given)


def _box(given: DetectionLike) -> BoxLike:
    """The detection in a field: a box. Raises InvalidDetectionError."""
    if is_image_detection(given):
        raise image_detection_in_field()
    return given  # type: ignore[return-value]


__all__ = ["Frame", "register", "register_batch", "search"]
