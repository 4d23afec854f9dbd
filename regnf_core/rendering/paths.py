"""Where the cameras of several frames stand: round a thing, at places of a list, or where a file says."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from regnf_core.geometry.box import OrientedBox
from regnf_core.rendering.camera import Camera, invalid_camera, up_vector
from regnf_core.rendering.options import check_extent

_ROOM_AROUND = 1.25
"""How much farther a camera of an orbit stands than fills the image with the box."""


@dataclass(frozen=True)
class Orbit:
    """Cameras on a circle round a box, all looking at its middle.

    elevation_deg: above the horizon · start_deg, sweep_deg: the first camera's turn about the vertical, and how far the
    last one is turned from it; a full turn ends one step before its start · distance: from the box's middle, scene
    units; None: so far that the whole box is in view · up: the scene's vertical.
    """

    frames: int = 8
    elevation_deg: float = 25.0
    start_deg: float = 0.0
    sweep_deg: float = 360.0
    distance: float | None = None
    field_of_view_deg: float = 50.0
    up: str = "z"

    def cameras(self, box: OrientedBox, size: tuple[int, int] = (640, 480)) -> list[Camera]:
        """size: width and height. Raises InvalidInputError (CAMERA_INVALID, RENDER_TOO_LARGE)."""
        if self.frames < 1:
            raise invalid_camera("an orbit has at least one frame")
        check_extent(self.frames, size[0] * size[1])
        if not -89.9 <= self.elevation_deg <= 89.9 or not math.isfinite(self.start_deg + self.sweep_deg):
            raise invalid_camera("an orbit's elevation is within -89.9 and 89.9 degrees")
        if self.distance is not None and not 0 < self.distance < math.inf:
            raise invalid_camera("an orbit's distance is above 0")
        up, full = up_vector(self.up), abs(self.sweep_deg) >= 360.0
        steps = self.frames if full else max(self.frames - 1, 1)
        first = torch.eye(3, dtype=torch.float64)[(int(up.abs().argmax()) + 1) % 3]
        second = torch.linalg.cross(up, first)
        away = self.distance or self._distance(box, size)
        tilt = math.radians(self.elevation_deg)
        found = []
        for frame in range(self.frames):
            turn = math.radians(self.start_deg + self.sweep_deg * frame / steps)
            level = math.cos(turn) * first + math.sin(turn) * second
            position = box.center + away * (math.cos(tilt) * level + math.sin(tilt) * up)
            found.append(Camera.look_at(position, box.center, size, self.field_of_view_deg, up))
        return found

    def _distance(self, box: OrientedBox, size: tuple[int, int]) -> float:
        """Of a ball that holds the box, in the narrower of the image's two angles."""
        half = math.radians(self.field_of_view_deg) / 2.0
        narrower = min(half, math.atan(math.tan(half) * size[1] / size[0]))
        return _ROOM_AROUND * 0.5 * box.diagonal / math.sin(narrower)


@dataclass(frozen=True)
class Station:
    """A place of a list. position, target: (3,), scene frame · up: the vertical, or any vector."""

    position: Sequence[float]
    target: Sequence[float]
    field_of_view_deg: float = 50.0
    up: str | Sequence[float] = "z"

    def camera(self, size: tuple[int, int] = (640, 480)) -> Camera:
        return Camera.look_at(self.position, self.target, size, self.field_of_view_deg, self.up)


def cameras_of_file(
    path: Path, T_scene_file: Tensor | None = None, size: tuple[int, int] | None = None, every: int = 1
) -> list[Camera]:
    """The cameras of transforms.json, meta_data.json and what else says where cameras stood, or of a folder with it.

    T_scene_file: (4, 4) similarity from the file's world to the scene; None: that to the dataset's where the file says
    it, else the same · size: width and height; None: 640 wide, the file's shape · every: take one of so many.
    Raises FieldFormatError (CAMERAS_...) and InvalidInputError (CAMERA_INVALID, RENDER_TOO_LARGE).
    """
    from regnf_core.importing.observing.reading import read_trajectory
    from regnf_core.importing.run.cameras_folder import packed_cameras
    from regnf_core.importing.run.opened import SettingsFile
    from regnf_core.importing.upload_description import CamerasDescription

    if every < 1:
        raise invalid_camera("take one camera of 1, 2, 3 ...")
    with packed_cameras(path) as file:
        found = read_trajectory([SettingsFile(file.name, memoryview(file.read_bytes()))], CamerasDescription())
    cameras = found.pinhole()
    if T_scene_file is not None:
        cameras = cameras.moved(T_scene_file)
    elif found.T_dataset_file is not None:
        cameras = cameras.moved(torch.from_numpy(found.T_dataset_file))
    chosen = range(0, len(cameras), every)
    wide = size or (640, max(1, round(640 / float(cameras.aspect[0]))))
    check_extent(len(chosen), wide[0] * wide[1])
    scale = torch.tensor(wide, dtype=torch.float64)
    return [
        Camera(
            cameras.positions[index],
            cameras.axes[index],
            wide[0],
            wide[1],
            tuple((cameras.focal[index] * scale).tolist()),
            tuple((cameras.middle[index] * scale).tolist()),
        )
        for index in chosen
    ]
