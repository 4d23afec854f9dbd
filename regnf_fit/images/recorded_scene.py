"""A recording as the scene of a registration: the region of the detection, its box, the scale that is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from regnf_core.detections.images import ImageDetection
from regnf_core.document import CameraView
from regnf_core.errors import InvalidDetectionError
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import METERS, RegistrationOptions, Unit
from regnf_data.agreement import check_agreement
from regnf_data.recordings.choosing import choose_frames
from regnf_data.recordings.detection import lift
from regnf_data.recordings.recording import Frame, Recording, as_posed_images
from regnf_fit.images.focus import focused_field

Floats = NDArray[np.float64]

_MOST_FRAMES = 8
"""That are read for one region, beside those of the detections."""
_AROUND = 0.35
"""Of the box's longest side, on each side of it: the region that is seen."""
_FITS, _APART = 0.85, 0.85
"""What is seen of an object has an extent of so many of its longest sides; e to the latter times more or less."""


@dataclass(frozen=True, eq=False)
class RecordedScene:
    """field: signed distances in the region, the recording's world · box: the detection, world · options: with the
    object's unit, where it is known · camera: the one of the image that the detection was made in · frame: that image ·
    frames: the names of those that were used · notes: what was taken for granted."""

    field: SdfField
    box: OrientedBox
    options: RegistrationOptions
    camera: CameraView
    frame: Frame
    frames: tuple[str, ...]
    notes: tuple[str, ...] = ()


def recorded_scene(
    recording: Recording,
    detection: OrientedBox | Sequence[ImageDetection],
    object_bounds: Floats | None = None,
    options: RegistrationOptions | None = None,
) -> RecordedScene:
    """The scene that ``detection``, a box in the recording's world or one thing in one or several frames, is about.

    object_bounds: (2, 3), the object's, its own unit; None where several objects are searched for. The object's unit is
    that of ``options.robust.object_unit``.
    Raises DatasetError and InvalidDetectionError, naming the frame.
    """
    options = options or RegistrationOptions()
    said: Unit = options.robust.object_unit if recording.is_metric else "free"
    if isinstance(detection, OrientedBox):
        box, own, first, extent = detection, [], [], float(detection.size.max())
        unit = _unit(said, extent, object_bounds)
    else:
        if not detection:
            raise InvalidDetectionError("no detection is given")
        indices = [recording.index(one.frame) for one in detection]
        own = [recording.frames[index].read() for index in indices]
        pairs = list(zip(own, detection, strict=True))
        first = [lift(frame, one) for frame, one in pairs]
        extent = max(float(np.ptp(each.points, axis=0).max()) for each in first)
        unit = _unit(said, extent, object_bounds)
        if unit in METERS and object_bounds is not None:
            diameter = METERS[unit] * float(np.linalg.norm(object_bounds[1] - object_bounds[0]))
            first = [lift(frame, one, diameter) for frame, one in pairs]
        box = first[0].box if len(first) == 1 else _common(first[0].box, np.concatenate([one.points for one in first]))
    region = OrientedBox(box.center, box.size + 2.0 * _AROUND * box.size.max(), box.rotation)
    names = [frame.name for frame in own]
    others: list[Frame] = []
    if len(recording) > len(own):
        chosen = choose_frames(recording, _MOST_FRAMES, region)
        others = [recording.frames[index].read() for index in chosen.indices]
        others = [frame for frame in others if frame.name not in names]
    frames = [*own, *others]
    disagreement = check_agreement(as_posed_images(frames, np.zeros((2, 3)))) if len(frames) > 1 else None
    field = focused_field(frames, region, things=[one.pixels for one in first])
    frame = own[0] if own else max(frames, key=lambda one: _shown(one, box))
    camera = CameraView(frame.name, Sim3.from_matrix(frame.T_world_camera.tolist()), METERS.get(unit))
    known = replace(options, robust=replace(options.robust, object_unit=unit))
    notes = recording.notes if disagreement is None else (*recording.notes, disagreement)
    if not recording.is_metric:
        notes += ("the recording's world is not in meters: the scale is free, and lengths are in its unit",)
    if unit in METERS and options.robust.object_unit == "auto":
        notes += (f"the object's unit is taken to be {unit}, by its size: say --object-unit, or --scale free",)
    return RecordedScene(field, box, known, camera, frame, tuple(one.name for one in frames), notes)


def _unit(said: Unit, extent: float, object_bounds: Floats | None) -> Unit:
    """The object's unit. `auto`: the one in which the object is as large as what was seen, `free` without one."""
    if said != "auto":
        return said
    if object_bounds is None:
        return "free"
    longest = float((object_bounds[1] - object_bounds[0]).max())
    apart = {name: abs(math.log(extent / (unit * longest * _FITS))) for name, unit in METERS.items()}
    fitting: list[Unit] = [name for name in METERS if apart[name] <= _APART]
    return min(fitting, key=lambda name: apart[name], default="free")


def _common(box: OrientedBox, points: Floats) -> OrientedBox:
    """The box of the axes of ``box`` round points (P, 3) that several frames show, and round ``box``'s own middle."""
    axes = box.rotation.numpy()
    local = points @ axes
    low, high = (np.quantile(local, share, axis=0) for share in (0.01, 0.99))
    center, size = axes @ ((low + high) / 2.0), (high - low) * 1.1
    return replace(box, center=torch.from_numpy(center), size=torch.from_numpy(np.maximum(size, 1e-3)))


def _shown(frame: Frame, box: OrientedBox) -> int:
    """How many measured pixels of a frame lie in the box."""
    points, _ = frame.points()
    local = (points - box.center.numpy()) @ box.rotation.numpy()
    return int((np.abs(local) <= box.size.numpy() / 2.0).all(axis=1).sum())
