"""Recordings as apps of phones export them: Polycam's raw data, 3D Scanner App, Record3D as EXR and JPG.

Cameras are ARKit's: they look against z, y is up; intrinsics are those of the color image. Facts are those of the apps'
documentation and of files that people show.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from regnf_core.errors import DatasetError
from regnf_data.recordings.camera import camera_of_values
from regnf_data.recordings.folders import _COLORS, DEPTHS, _first_file, frame_of, in_order, poses_of, read_json
from regnf_data.recordings.recording import Recording, StoredFrame, checked_size, pose_of, recording_of

if TYPE_CHECKING:
    from regnf_data.recordings.recording import Given

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_POLYCAM = ("corrected_cameras", "cameras")
"""Folders of keyframes/: poses that were adjusted later go before the sensor's."""
_Shot = tuple[str, Any, Any, Path | None, Path | None]
"""Name, what has the intrinsics, pose, depth image, color image."""


def is_phone(path: Path) -> bool:
    if any((path / "keyframes" / one).is_dir() for one in _POLYCAM):
        return True
    record3d = (path / "metadata.json").is_file() and (path / "depth").is_dir()
    return record3d or (any(path.glob("frame_*.json")) and any(path.glob("depth_*")))


def _shots(folder: Path) -> Iterator[_Shot]:
    keyframes = folder / "keyframes"
    if keyframes.is_dir():
        cameras = next(one for one in _POLYCAM if (keyframes / one).is_dir())
        colors = keyframes / cameras.replace("cameras", "images")
        for file in in_order(keyframes / cameras, (".json",)):
            said, names = read_json(file), (file.stem,)
            pose = [[said[f"t_{row}{column}"] for column in range(4)] for row in range(3)]
            depth = _first_file(keyframes / "depth", names, DEPTHS)
            yield file.stem, said, pose, depth, _first_file(colors, names, _COLORS)
        return
    if (folder / "metadata.json").is_file():
        said = read_json(folder / "metadata.json")
        K = np.reshape(said["K"], (3, 3)).T.tolist()  # it is written by columns
        camera, poses = {"K": K, "width": said["w"], "height": said["h"]}, np.array(said["poses"], np.float64)
        for number, pose in enumerate(poses_of(poses[:, 4:], poses[:, :4], "metadata.json")):
            depth = _first_file(folder / "depth", (str(number),), DEPTHS)
            yield str(number), camera, pose, depth, _first_file(folder / "rgb", (str(number),), _COLORS)
        return
    files = in_order(folder, (".json",), "frame_")
    pictures = {file: _first_file(folder, (file.stem,), _COLORS) for file in files}  # not every frame has one
    size = next((checked_size(color) for color in pictures.values() if color is not None), (1440, 1920))
    for file, color in pictures.items():
        said = read_json(file) | {"height": size[0], "width": size[1]}
        depth = _first_file(folder, (file.stem.replace("frame_", "depth_"),), DEPTHS)
        yield file.stem, said, said["cameraPoseARFrame"], depth, color


def read_phone(folder: Path, given: Given) -> Recording:
    """Millimeters, or meters in EXR."""
    frames: list[StoredFrame | None] = []
    for name, said, matrix, depth, color in _shots(folder):
        found, pose = camera_of_values(said, name), pose_of(matrix, name)
        camera = given.camera or (found.camera if found else None)
        if camera is None:
            raise DatasetError(f"{name} has no intrinsics", reason="DATASET_INTRINSICS_INVALID")
        turned = None if pose is None else pose @ _OPENGL
        frames.append(frame_of(name, camera, turned, depth, given.depth_unit or 0.001, color))
    return recording_of(folder.name, "a phone's app", frames)
