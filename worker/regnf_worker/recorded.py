"""Scenes that are recordings: what an import makes of one, and the place in it where a job looks for its object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from regnf_core.detections import Detection
from regnf_core.errors import DatasetError
from regnf_core.options import RegistrationOptions
from regnf_state.registration_request import RegistrationRequest

if TYPE_CHECKING:
    from regnf_core.document import CameraView, RegistrationResult
    from regnf_core.fields.observation import SdfField
    from regnf_core.geometry.box import OrientedBox
    from regnf_data.recordings.recording import Frame

OVERLAY = "overlay.png"
"""The artifact that shows the object's outline on the image of the detection."""


@dataclass(frozen=True, eq=False)
class Place:
    """Where a job looks: the scene or the region of it, the box, and the options with what the scene says of the scale.
    camera, frame: the image of the detection, where the scene is a recording."""

    field: SdfField
    box: OrientedBox
    options: RegistrationOptions
    camera: CameraView | None = None
    frame: Frame | None = None

    @property
    def pictures(self) -> tuple[str, ...]:
        """The files that ``draw`` writes."""
        return () if self.frame is None else (OVERLAY,)

    def seen(self, result: RegistrationResult) -> RegistrationResult:
        """The result with the camera that saw the object."""
        return result if self.camera is None else replace(result, camera=self.camera)

    def draw(self, result: RegistrationResult, obj: SdfField, folder: Path) -> list[str]:
        """Write the overlay, if there is an image; the names of the files."""
        if self.frame is None:
            return []
        from regnf_fit.images.overlay import object_mesh, overlay_picture

        overlay_picture(result, self.frame, *object_mesh(obj)).save(folder / OVERLAY)
        return [OVERLAY]


def place_of(scene: Path, request: RegistrationRequest, obj: Any, device: str) -> Place:
    """The place that a request is about. obj: the object's model or field; None: there are several.

    Raises RegnfError: those of a field's file, DatasetError and InvalidDetectionError, naming the frame.
    """
    from regnf_core.fields.build import open_field
    from regnf_core.geometry.box import OrientedBox
    from regnf_data.recordings.stored import is_stored, read_stored
    from regnf_fit.images.recorded_scene import recorded_scene

    detection: Any = request.detection
    if isinstance(detection, Detection):
        detection = OrientedBox.from_detection(detection)
    if not is_stored(scene):
        return Place(open_field(scene, device), detection, request.options)
    bounds = None if obj is None else obj.bounds.cpu().numpy()
    found = recorded_scene(read_stored(scene, "the recording"), detection, bounds, request.options)
    return Place(found.field.to(device), found.box, found.options, found.camera, found.frame)


def joined_recordings(first: Path, added: Path, name: str, target: Path) -> None:
    """Write a stored recording of the frames of ``first`` and the only one of ``added``, which gets this name.

    Raises DatasetError (DATASET_FRAMES_INVALID) where a frame has the name already, or is of another size.
    """
    from regnf_data.recordings.stored import read_stored, write_recording

    held, one = read_stored(first, "the recording"), read_stored(added, name)
    if any(frame.name == name for frame in held.frames):
        raise DatasetError(f"the recording has a frame {name} already", reason="DATASET_FRAMES_INVALID")
    whole = replace(held, frames=(*held.frames, replace(one.frames[0], name=name)))
    if len(write_recording(whole, range(len(whole)), target)["frames"]) < len(whole):
        message = f"frame {name} has another size than the frames before"
        raise DatasetError(message, reason="DATASET_SIZES_DIFFER")


def joined_reports(first: Mapping[str, Any], added: Mapping[str, Any], name: str) -> dict[str, Any]:
    """What is known of such a recording."""
    corners = zip(first["bounds"], added["bounds"], (min, max), strict=True)
    bounds = [list(map(choose, a, b)) for a, b, choose in corners]
    return {**first, "bounds": bounds, "frames": [*first["frames"], name]}
