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
from regnf_data.recordings.detection import Lifted, lift
from regnf_data.recordings.recording import Frame, Recording, as_posed_images
from regnf_fit.images.aligning import align_frames
from regnf_fit.images.focus import focused_field

Floats = NDArray[np.float64]

_MOST_FRAMES = 8
"""That are used for one region, with those of the detections."""
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
    first: list[Lifted] = []
    own: list[Frame] = []
    told: tuple[str, ...] = ()
    if isinstance(detection, OrientedBox):
        box = detection
        unit = _unit(said, float(detection.size.max()), object_bounds)
    else:
        if not detection:
            raise InvalidDetectionError("no detection is given")
        shown, unit, diameter = _lifted(recording, detection[:_MOST_FRAMES], said, object_bounds)
        first = _meeting(shown, diameter)
        box = first[0].box if len(first) == 1 else _common(first, diameter)
        own = [one.frame for one in first]
        left = ", ".join(one.frame.name for one in shown if one not in first)
        told = (f"the detections of other frames show another object than {left}: they are not used",) if left else ()
    region = _around(box)
    names = [frame.name for frame in own]
    others: list[Frame] = []
    if len(recording) > len(own) and len(own) < _MOST_FRAMES:
        chosen = [recording.frames[index] for index in choose_frames(recording, _MOST_FRAMES, region).indices]
        others = [frame.read(color=not own) for frame in chosen if frame.name not in names]
    frames = [*own, *others][:_MOST_FRAMES]
    disagreement = check_agreement(as_posed_images(frames, np.zeros((2, 3)), recording.terms))
    if disagreement is not None:  # by no convention do they show one scene: together they would show another one
        frames, first = [own[0] if own else max(frames, key=lambda one: _shown(one, box))], first[:1]
        box = first[0].box if first else box
        region, disagreement = _around(box), f"{disagreement}. Only the frame {frames[0].name} is used"
    aligned = align_frames(frames, region)
    frames = list(aligned.frames)
    field = focused_field(frames, region, spread=aligned.spread, things=[one.pixels for one in first])
    frame = frames[0] if own else max(frames, key=lambda one: _shown(one, box))
    camera = CameraView(frame.name, Sim3.from_matrix(frame.T_world_camera.tolist()), METERS.get(unit))
    known = replace(options, robust=replace(options.robust, object_unit=unit))
    notes = (*recording.notes, *told, *([disagreement] if disagreement else ()), *aligned.notes)
    if not recording.is_metric:
        notes += ("the recording is not in meters: the scale is free, and lengths are in the recording's unit",)
    if unit in METERS and options.robust.object_unit == "auto":
        notes += (
            f"the object's unit is assumed to be {unit}, from its size; if not, give --object-unit, or --scale free",
        )
    return RecordedScene(field, box, known, camera, frame, tuple(one.name for one in frames), notes)


def _around(box: OrientedBox) -> OrientedBox:
    """The region that is seen."""
    return OrientedBox(box.center, box.size + 2.0 * _AROUND * box.size.max(), box.rotation)


def _unit(said: Unit, extent: float, object_bounds: Floats | None) -> Unit:
    """The object's unit. `auto`: the one in which the object's size matches the observed surface, `free` without
    one."""
    if said != "auto":
        return said
    if object_bounds is None:
        return "free"
    longest = float((object_bounds[1] - object_bounds[0]).max())
    apart = {name: abs(math.log(extent / (unit * longest * _FITS))) for name, unit in METERS.items()}
    fitting: list[Unit] = [name for name in METERS if apart[name] <= _APART]
    return min(fitting, key=lambda name: apart[name], default="free")


def _lifted(
    recording: Recording, detections: Sequence[ImageDetection], said: Unit, object_bounds: Floats | None
) -> tuple[list[Lifted], Unit, float | None]:
    """The instances of the detections, the object's unit, and its diameter in the world where that is known."""
    frames = [recording.frames[recording.index(one.frame)].read() for one in detections]
    pairs = list(zip(frames, detections, strict=True))
    shown: list[Lifted] = []
    unit = said
    if said == "auto" or object_bounds is None:
        shown = [lift(frame, one) for frame, one in pairs]
        unit = _unit(said, max(float(np.ptp(each.points, axis=0).max()) for each in shown), object_bounds)
    if unit not in METERS or object_bounds is None:
        return shown or [lift(frame, one) for frame, one in pairs], unit, None
    diameter = METERS[unit] * float(np.linalg.norm(object_bounds[1] - object_bounds[0]))
    return [lift(frame, one, diameter) for frame, one in pairs], unit, diameter


def _meeting(shown: list[Lifted], diameter: float | None) -> list[Lifted]:
    """Of the objects that detections of frames show, those that meet most others in space: they are one.

    Raises InvalidDetectionError, naming the frames, where none of several meets another.
    """
    middles = np.stack([one.box.center.numpy() for one in shown])
    reach = diameter or max(float(one.box.size.max()) for one in shown)
    apart = np.linalg.norm(middles[:, None] - middles[None], axis=-1)
    meets = apart <= reach
    best = max(range(len(shown)), key=lambda one: (int(meets[one].sum()), -float(apart[one][meets[one]].sum())))
    if len(shown) > 1 and meets[best].sum() == 1:
        names = ", ".join(one.frame.name for one in shown)
        nearest = float(apart[apart > 0.0].min(initial=np.inf))
        raise InvalidDetectionError(
            f"the detections of the frames {names} show no common object: they are at least {nearest:.2g} apart in "
            f"space, and the object's size is {reach:.2g}. Check the frames' poses, or give the detections of one frame"
        )
    return [one for one, found in zip(shown, meets[best], strict=True) if found]


def _common(shown: Sequence[Lifted], diameter: float | None) -> OrientedBox:
    """The box of the axes of the first one round what several frames show of one object; behind, seen from the first,
    it reaches as far as the object is wide."""
    box = shown[0].box
    axes = box.rotation.numpy()
    local = np.concatenate([one.points for one in shown]) @ axes
    if diameter is not None:
        local = local[np.linalg.norm(local - np.median(local, axis=0), axis=1) <= diameter]
    low, high = (np.quantile(local, share, axis=0) for share in (0.01, 0.99))
    high[2] = max(high[2], low[2] + (high - low)[:2].max())
    center, size = axes @ ((low + high) / 2.0), (high - low) * 1.1
    return replace(box, center=torch.from_numpy(center), size=torch.from_numpy(np.maximum(size, 1e-3)))


def _shown(frame: Frame, box: OrientedBox) -> int:
    """How many measured pixels of a frame lie in the box."""
    points, _ = frame.points()
    local = (points - box.center.numpy()) @ box.rotation.numpy()
    return int((np.abs(local) <= box.size.numpy() / 2.0).all(axis=1).sum())
