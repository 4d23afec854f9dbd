"""The cameras of a file as a request's poses, without torch: counted and checked before any work begins."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from regnf_core.errors import FieldFormatError, InvalidInputError

Rows = list[list[float]]
_WIDTH = 640


def poses_of_file(path: Path, size: tuple[int, int] | None, every: int) -> list[dict[str, Any]]:
    """As :func:`poses_of_transforms`, of transforms.json, meta_data.json and what else says where cameras stood, or of
    a folder with it. Raises FieldFormatError (CAMERAS_...)."""
    from regnf_core.importing.run.folder import packed_cameras

    with packed_cameras(path) as file:
        return _poses(file.name, file.read_bytes(), None, size, every)


def poses_of_transforms(
    document: dict[str, Any], T_scene_file: Rows | None, size: tuple[int, int] | None, every: int
) -> list[dict[str, Any]]:
    """The poses, plain values of ``PoseRequest``, of every so-many-th camera of a transforms.json.

    T_scene_file: from the file's world to the scene; None: that to the dataset's where the file says it, else the
    same · size: width and height of all; None: 640 wide, the file's shape. Raises InvalidInputError (CAMERA_INVALID).
    """
    try:
        return _poses("transforms.json", json.dumps(document).encode(), T_scene_file, size, every)
    except FieldFormatError as error:
        raise InvalidInputError(str(error), reason="CAMERA_INVALID", hint=error.hint) from error


def _poses(
    name: str, content: bytes, T_scene_file: Rows | None, size: tuple[int, int] | None, every: int
) -> list[dict[str, Any]]:
    import numpy as np

    from regnf_core.importing.observing.reading import read_trajectory
    from regnf_core.importing.run.opened import SettingsFile
    from regnf_core.importing.upload_description import CamerasDescription

    with np.errstate(all="ignore"):  # what is not finite in the end is refused
        found = read_trajectory([SettingsFile(name, memoryview(content))], CamerasDescription())
        T = found.T_dataset_file if T_scene_file is None else np.array(T_scene_file, np.float64)
        poses = found.poses[::every].copy()
        if T is not None:
            turn = T[:3, :3] / np.cbrt(np.linalg.det(T[:3, :3]))
            poses[:, :3, 3] = poses[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
            poses[:, :3, :3] = turn @ poses[:, :3, :3]
        wide = size or (_WIDTH, max(1, round(_WIDTH / float(found.aspect[0]))))
        lenses = np.concatenate([found.focal, found.middle], axis=1)[::every] * np.array([*wide, *wide])
    return [
        {"T_scene_camera": pose, "intrinsics": lens, "size": wide}
        for pose, lens in zip(poses.tolist(), lenses.tolist(), strict=True)
    ]
