"""The cameras of a transforms.json as a request's poses, without torch: counted and checked before any work begins."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from regnf_core.errors import FieldFormatError, InvalidInputError

if TYPE_CHECKING:
    from regnf_core.importing.observing.trajectory import Trajectory

Rows = list[list[float]]
_WIDTH = 640


def poses_of_transforms(
    document: dict[str, Any], T_scene_file: Rows | None, size: tuple[int, int] | None, every: int
) -> list[dict[str, Any]]:
    """The poses, plain values of ``PoseRequest``, of every so-many-th camera.

    T_scene_file: from the file's world to the scene; None: that to the dataset's where the file says it, else the
    same · size: width and height of all; None: 640 wide, the file's shape. Raises InvalidInputError (CAMERA_INVALID).
    """
    import numpy as np

    from regnf_core.importing.observing.reading import read_trajectory
    from regnf_core.importing.run.opened import SettingsFile
    from regnf_core.importing.upload_description import CamerasDescription

    file = SettingsFile("transforms.json", memoryview(json.dumps(document).encode()))
    with np.errstate(all="ignore"):  # what is not finite in the end is refused
        try:
            found = read_trajectory([file], CamerasDescription())
        except FieldFormatError as error:
            raise InvalidInputError(str(error), reason="CAMERA_INVALID", hint=error.hint) from error
        return _poses(found, T_scene_file, size, every)


def _poses(
    found: Trajectory, T_scene_file: Rows | None, size: tuple[int, int] | None, every: int
) -> list[dict[str, Any]]:
    import numpy as np

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
