"""The cameras in whatever files came: the first format that fits is read."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.observing.trajectory import (
    MOST_CAMERAS,
    Intrinsics,
    Trajectory,
    malformed,
    trajectory_of,
    without_intrinsics,
)
from regnf_core.importing.observing.trajectory_json import is_trajectory, read_trajectory_json
from regnf_core.importing.observing.trajectory_text import read_matrices, read_tum
from regnf_core.importing.settings.json_reader import read_json
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.plain import looks_like_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from regnf_core.importing.run.opened import SettingsFile
    from regnf_core.importing.upload_description import CamerasDescription

_ARRAY_BYTES = 64 << 20
_KNOWN_NAMES = ("transforms.json", "transforms_train.json", "meta_data.json", "cameras_sphere.npz")


def read_trajectory(files: Sequence[SettingsFile], said: CamerasDescription) -> Trajectory:
    """The cameras in ``files``; ``said`` where they do not say.

    Raises FieldFormatError: CAMERAS_NOT_RECOGNIZED, CAMERAS_MALFORMED, CAMERAS_INTRINSICS_MISSING,
    CAMERAS_NOT_SUPPORTED, SETTINGS_TOO_LARGE and those of a malformed .npz file.
    """
    try:
        found = _read(files, said)
    except FieldFormatError as error:
        if error.reason != "SETTINGS_MALFORMED":
            raise
        raise malformed(str(error)) from error
    if found is None:
        names = ", ".join(PurePosixPath(file.name).name[:60] for file in files[:6]) or "no file"
        message = f"no cameras in {names}: expected transforms.json, meta_data.json, poses of TUM or a matrix a file"
        raise FieldFormatError(message, reason="CAMERAS_NOT_RECOGNIZED")
    return found


def beside_checkpoint(files: Sequence[SettingsFile]) -> tuple[SettingsFile, ...]:
    """Those of a run's settings that say where its cameras stood, by their names."""
    named = {PurePosixPath(file.name).name: file for file in files}
    return next(((named[name],) for name in _KNOWN_NAMES if name in named), ())


def _read(files: Sequence[SettingsFile], said: CamerasDescription) -> Trajectory | None:
    for file in sorted(files, key=lambda file: _rank(file.name)):
        name = PurePosixPath(file.name).name
        if name.lower().endswith(".npz"):
            return _of_arrays(name, ArraySource(file.data, _ARRAY_BYTES), said)
        if looks_like_json(file.data):
            keys = Keys(name, read_json(name, file.data))
            if is_trajectory(keys):
                return read_trajectory_json(keys, _said(said), said.axes)
    return _of_text(files, said)


def _rank(name: str) -> tuple[int, str]:
    """Known names first."""
    known = PurePosixPath(name).name
    return (_KNOWN_NAMES.index(known) if known in _KNOWN_NAMES else len(_KNOWN_NAMES)), name


def _of_text(files: Sequence[SettingsFile], said: CamerasDescription) -> Trajectory | None:
    texts = [(file.name, file.data) for file in files if not file.name.lower().endswith((".json", ".npz"))]
    if not texts:
        return None
    poses, matrix = read_matrices(texts)
    name = texts[0][0] if len(texts) == 1 else "the folder of poses"
    if poses is None:
        found = [(tum, file) for file, data in texts if (tum := read_tum(file, data)) is not None]
        if not found:
            return None
        poses, name = found[0]
    intrinsics = _said(said)
    if intrinsics is None and matrix is not None:
        width, height = said.size or (2 * matrix[0, 2], 2 * matrix[1, 2])
        intrinsics = Intrinsics(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], width, height)
    if intrinsics is None:
        raise without_intrinsics(name)
    return trajectory_of(name, poses, intrinsics, said.axes or "opencv")


def _of_arrays(name: str, arrays: ArraySource, said: CamerasDescription) -> Trajectory | None:
    """NeuS's cameras: ``world_mat_0`` and so on, each the product of intrinsics and the world's place in the camera."""
    from scipy.linalg import rq

    poses, intrinsics = [], []
    for index in range(MOST_CAMERAS):
        if f"world_mat_{index}" not in arrays:
            break
        matrix = arrays.numbers(f"world_mat_{index}")
        if matrix.shape not in ((3, 4), (4, 4)) or not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
            raise malformed(f"{name}: world_mat_{index} is no camera's projection")
        K, R = rq(matrix[:3, :3])
        turn = np.diag(np.sign(np.diag(K)))
        K, R = K @ turn, turn @ R
        if np.linalg.det(R) < 0:
            R, matrix = -R, -matrix
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R.T, -np.linalg.solve(matrix[:3, :3], matrix[:3, 3])
        K = K / K[2, 2]
        width, height = said.size or (2 * K[0, 2], 2 * K[1, 2])
        if not (width > 0 and height > 0):  # the images' size is not in the file
            raise without_intrinsics(name)
        poses.append(pose)
        intrinsics.append(Intrinsics(K[0, 0], K[1, 1], K[0, 2], K[1, 2], width, height))
    if not poses:
        return None
    return trajectory_of(name, np.stack(poses), _said(said) or intrinsics, None, np.eye(4))


def _said(said: CamerasDescription) -> Intrinsics | None:
    """The intrinsics that the description gives."""
    if said.intrinsics is None:
        return None
    fx, fy, cx, cy = said.intrinsics
    width, height = said.size or (2 * cx, 2 * cy)
    return Intrinsics(fx, fy, cx, cy, width, height)
