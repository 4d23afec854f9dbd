"""Where one object is looked for: in a scene's field, or in the region of a recording that a detection is about."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from regnf_core.detections import Detection
from regnf_core.detections.images import AnyDetection, image_detection_in_field
from regnf_core.document import CameraView, RegistrationResult
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.options import RegistrationOptions
from regnf_data.recordings.recording import Frame, Recording

OVERLAY = "overlay.png"
"""The artifact that shows the object's outline on the image of the detection."""


@dataclass(frozen=True, eq=False)
class Place:
    """field: the scene or the region of it · options: with what the scene says of the scale · camera, frame: the image
    of the detection, where the scene is a recording · notes: what was taken for granted."""

    field: SdfField
    box: OrientedBox
    options: RegistrationOptions
    camera: CameraView | None = None
    frame: Frame | None = None
    notes: tuple[str, ...] = ()

    @property
    def pictures(self) -> tuple[str, ...]:
        """The files that ``draw`` writes."""
        return () if self.frame is None else (OVERLAY,)

    def seen(self, result: RegistrationResult) -> RegistrationResult:
        """The result with the camera that saw the object."""
        return result if self.camera is None else replace(result, camera=self.camera)

    def draw(self, result: RegistrationResult, obj: SdfField, folder: Path) -> list[str]:
        """Write the overlay, if there is an image; the names of the files."""
        if self.frame is not None:
            from regnf_fit.images.overlay import object_mesh, overlay_picture

            overlay_picture(result, self.frame, *object_mesh(obj)).save(folder / OVERLAY)
        return [*self.pictures]


def place_in(
    scene: SdfField | Recording, detection: AnyDetection, bounds: Tensor | None, options: RegistrationOptions
) -> Place:
    """The place in ``scene`` that ``detection`` is about. bounds: (2, 3), of the only object, whose size tells its
    unit; None where several are searched for.

    Raises DatasetError and InvalidDetectionError, naming the frame.
    """
    where = OrientedBox.from_detection(detection) if isinstance(detection, Detection) else detection
    if not isinstance(scene, Recording):
        if not isinstance(where, OrientedBox):
            raise image_detection_in_field()
        return Place(scene, where, options)
    from regnf_fit.images.recorded_scene import recorded_scene

    found = recorded_scene(scene, where, None if bounds is None else bounds.cpu().numpy(), options)
    return Place(found.field, found.box, found.options, found.camera, found.frame, found.notes)
