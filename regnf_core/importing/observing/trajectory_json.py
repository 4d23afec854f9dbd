"""nerfstudio's transforms.json and its likes, and sdfstudio's meta_data.json, without their images."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.observing.trajectory import (
    MOST_CAMERAS,
    Array,
    Axes,
    Intrinsics,
    Trajectory,
    malformed,
    trajectory_of,
    without_intrinsics,
)
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.similarity import is_similarity

_PINHOLES = re.compile(r"OPENCV|PERSPECTIVE|(SIMPLE_)?(PINHOLE|RADIAL)")
"""Camera models whose images are those of a pinhole, but for a little distortion."""
_POSES = "transform_matrix", "camtoworld"
_SIDE = 1000.0
"""Pixels along an image's side, where a file gives an angle in place of pixels: any number is right."""


def is_trajectory(keys: Keys) -> bool:
    """Whether the file lists frames with poses."""
    frames = keys.find("frames")
    first = frames[0] if isinstance(frames, list) and frames else None
    return isinstance(first, dict) and any(name in first for name in _POSES)


def read_trajectory_json(keys: Keys, intrinsics: Intrinsics | None, axes: Axes | None) -> Trajectory:
    """The cameras in a file for which :func:`is_trajectory` holds. intrinsics, axes: where the file does not say.

    Raises FieldFormatError: CAMERAS_MALFORMED, CAMERAS_NOT_SUPPORTED, CAMERAS_INTRINSICS_MISSING, SETTINGS_MALFORMED.
    """
    _require_pinhole(keys)
    frames = list(_frames(keys))
    ours = "camtoworld" in frames[0].find("")
    name = _POSES[1] if ours else _POSES[0]
    poses = np.stack([_pose(frame, name) for frame in frames])
    each = [_intrinsics(frame, keys) or intrinsics for frame in frames]
    found = [one for one in each if one is not None]
    if len(found) < len(each):
        raise without_intrinsics(keys.file)
    convention = axes or ("opencv" if ours else "opengl")
    return trajectory_of(keys.file, poses, found, convention, _to_dataset(keys, ours))


def _require_pinhole(keys: Keys) -> None:
    model = keys.find("camera_model")
    if model is not None and not _PINHOLES.fullmatch(str(model)):
        message = f"{keys.file}: cameras of the model {str(model)[:40]} are not supported"
        raise FieldFormatError(message, reason="CAMERAS_NOT_SUPPORTED")


def _frames(keys: Keys) -> Iterator[Keys]:
    values = keys.find("frames")
    if len(values) > MOST_CAMERAS:
        raise malformed(f"{keys.file} lists more than {MOST_CAMERAS} cameras")
    for index, value in enumerate(values):
        if not isinstance(value, dict):
            raise malformed(f"{keys.file}: frames.{index} is no frame")
        yield Keys(keys.file, value, f"frames.{index}.")


def _pose(frame: Keys, name: str) -> Array:
    """(4, 4) from four rows, or from three."""
    value = frame.find(name)
    rows = len(value) if isinstance(value, list) else 0
    found = frame.matrix(name, 3 if rows == 3 else 4, 4)
    if found is None:
        raise malformed(f"{frame.file}: {frame.at}{name} is missing")
    return np.array([*found, *([[0.0, 0.0, 0.0, 1.0]] if rows == 3 else [])])


def _intrinsics(frame: Keys, keys: Keys) -> Intrinsics | None:
    """The frame's own, or else those of all frames; None where neither says."""

    def number(*names: str) -> float | None:
        found = (each.number(name) for each in (frame, keys) for name in names)
        return next((one for one in found if one is not None), None)

    width, height = number("w", "width"), number("h", "height")
    matrix = next((rows for each in (frame, keys) if (rows := _matrix(each)) is not None), None)
    if matrix is not None:
        (fx, _, cx, *_), (_, fy, cy, *_) = matrix[:2]
        return Intrinsics(fx, fy, cx, cy, width or 2 * cx, height or 2 * cy)
    middle_x, middle_y = number("cx"), number("cy")
    width = width or (2 * middle_x if middle_x else _SIDE)
    height = height or (2 * middle_y if middle_y else width)
    focal_x = number("fl_x") or _focal(width, number("camera_angle_x"))
    focal_y = number("fl_y") or _focal(height, number("camera_angle_y"))
    if focal_x is None and focal_y is None:
        return None
    cx = width / 2 if middle_x is None else middle_x
    cy = height / 2 if middle_y is None else middle_y
    return Intrinsics(focal_x or focal_y or 0.0, focal_y or focal_x or 0.0, cx, cy, width, height)


def _focal(side: float, angle: float | None) -> float | None:
    """In pixels, from the angle (radians) that an image spans along one side."""
    return None if angle is None or not 0 < angle < math.pi else side / 2 / math.tan(angle / 2)


def _matrix(keys: Keys) -> list[list[float]] | None:
    """The 3 x 3 or 4 x 4 matrix ``intrinsics``, or its first three rows."""
    value = keys.find("intrinsics")
    if not isinstance(value, list) or not value or not isinstance(value[0], list):
        return None
    return keys.matrix("intrinsics", len(value), len(value[0])) if min(len(value), len(value[0])) >= 3 else None


def _to_dataset(keys: Keys, ours: bool) -> Array | None:
    """From the file's world to that of the data which the trainer's frame is told against."""
    if ours:
        rows = keys.matrix("worldtogt", 4, 4)
        return None if rows is None or not is_similarity(rows) else np.array(rows)
    applied = keys.find("applied_transform")
    rows = keys.matrix("applied_transform", 4 if isinstance(applied, list) and len(applied) == 4 else 3, 4)
    if rows is None:
        return None
    scale = keys.number("applied_scale") or 1.0
    forward = np.eye(4)
    forward[:3] = np.array(rows)[:3]
    forward[:3] *= scale
    if not is_similarity(forward):
        raise malformed(f"{keys.file}: applied_transform is no rotation and place")
    return np.asarray(np.linalg.inv(forward), np.float64)
