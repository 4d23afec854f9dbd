"""The cameras in whatever files came: the first format that fits is read."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.containers.plain_text import number
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
from regnf_core.importing.settings.facts import is_similarity
from regnf_core.importing.settings.keys import MAX_NUMBER_CHARACTERS, Keys, decoded, looks_like_json, read_json
from regnf_core.rotations import rotation_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from regnf_core.importing.run.opened import SettingsFile
    from regnf_core.importing.upload_description import CamerasDescription


# nerfstudio's transforms.json and its likes, and sdfstudio's meta_data.json, without their images.

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
            raise malformed(f"{keys.file}: frames.{index} is not a frame")
        yield Keys(keys.file, value, f"frames.{index}.")


def _pose(frame: Keys, name: str) -> Array:
    """(4, 4) from four rows, or from three; NaN for a camera that was lost."""
    value = frame.find(name)
    rows = len(value) if isinstance(value, list) else 0
    if (value is None and name in frame.find("")) or any(None in row for row in value or () if isinstance(row, list)):
        return np.full((4, 4), np.nan)
    found = frame.matrix(name, 3 if rows == 3 else 4, 4)
    if found is None:
        raise malformed(f"{frame.file}: {frame.at}{name} is missing")
    return np.array([*found, *([[0.0, 0.0, 0.0, 1.0]] if rows == 3 else [])])


def _intrinsics(frame: Keys, keys: Keys) -> Intrinsics | None:
    """The frame's own, or else those of all frames; None where neither says."""

    def stated(*names: str) -> float | None:
        found = (each.number(name) for each in (frame, keys) for name in names)
        return next((one for one in found if one is not None), None)

    width, height = stated("w", "width"), stated("h", "height")
    matrix = next((rows for each in (frame, keys) if (rows := _matrix(each)) is not None), None)
    if matrix is not None:
        (fx, _, cx, *_), (_, fy, cy, *_) = matrix[:2]
        return Intrinsics(fx, fy, cx, cy, width or 2 * cx, height or 2 * cy)
    middle_x, middle_y = stated("cx"), stated("cy")
    width = width or (2 * middle_x if middle_x else _SIDE)
    height = height or (2 * middle_y if middle_y else width)
    focal_x = stated("fl_x") or _focal(width, stated("camera_angle_x"))
    focal_y = stated("fl_y") or _focal(height, stated("camera_angle_y"))
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
        raise malformed(f"{keys.file}: applied_transform is not a rotation and a translation")
    return np.asarray(np.linalg.inv(forward), np.float64)


# Poses as plain numbers: a file of lines, TUM's, EuRoC's or matrices; or a folder with a matrix a file.

MOST_BYTES = 8 << 20
_NOT_UNIT = 0.05
"""How far from one a quaternion's length may be in lines of more than eight numbers."""
_NANOSECONDS = 1e15
"""Time stamps beyond are no seconds."""
_NUMBERS = re.compile(r"[0-9]+")
_SEPARATORS = re.compile(r"[\s,;\[\]()]+")
_CELLS = re.compile(r"[;\t]")
_STARTS = re.compile(r"[-+.\d]|nan|inf", re.IGNORECASE)
_NAMES_FIRST = re.compile(r"(time|stamp|frame|x$|tx$|p_)", re.IGNORECASE)


def read_lines(name: str, data: bytes | memoryview, most: int = MOST_BYTES) -> Array | None:
    """The poses (N, 4, 4), camera to world, of a file of lines; None where it is none.

    TUM's (t, place, quaternion x y z w, with a number behind of RTAB-Map), EuRoC's (ns, w first, by commas), Stray
    Scanner's (t, frame, place, quaternion), matrices of 12 (KITTI) or 16 numbers, or in four rows, with or without
    their number before (Redwood). Lines that are empty or begin with # or with names of columns are passed over.
    Raises FieldFormatError (CAMERAS_MALFORMED).
    """
    rows = _rows(name, data, most)
    widths = {len(row) for row in rows}
    if widths == {3, 4} and len(rows) % 5 == 0 and all(len(row) == 3 for row in rows[::5]):
        rows, widths = [row for at, row in enumerate(rows) if at % 5], {4}
    if widths == {4} and len(rows) % 4 == 0:
        return np.array(rows, np.float64).reshape(-1, 4, 4)
    if widths in ({12}, {16}):
        return _closed(np.array(rows, np.float64).reshape(len(rows), -1, 4))
    if len(widths) != 1 or not 8 <= (width := widths.pop()) <= 32:
        return None
    values = np.array(rows, np.float64)
    stray = width in (9, 13) and bool((values[:, 1] == np.arange(len(values))).all())
    at = 2 if stray else 1
    if width > 8 and not stray and not (width == 9 or (values[:, 0] > _NANOSECONDS).all()):
        return None
    euroc = not stray and bool((values[:, 0] > _NANOSECONDS).all()) and b"," in bytes(data[:4096])
    quaternions = values[:, at + 3 : at + 7]
    with np.errstate(all="ignore"):
        odd = np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) > _NOT_UNIT
    if width > 8 and odd.any():  # other tables have as many numbers
        return None
    return poses_of(values[:, at : at + 3], np.roll(quaternions, -1, axis=1) if euroc else quaternions)


def poses_of(places: Array, quaternions: Array) -> Array:
    """(N, 4, 4) of places (N, 3) and quaternions (N, 4), x y z w, of any length; NaN where that is zero."""
    with np.errstate(all="ignore"):
        x, y, z, w = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    poses[:, :3, :3] = np.array(rotation_rows(x, y, z, w)).transpose(2, 0, 1)
    return poses


def _closed(rows: Array) -> Array:
    """(N, 4, 4) of (N, 3 or 4, 4)."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, : rows.shape[1]] = rows
    return poses


def read_matrices(files: Sequence[tuple[str, bytes | memoryview]]) -> tuple[Array | None, Array | None]:
    """The poses (N, 4, 4) of files with a 4 x 4 or 3 x 4 matrix each, by the numbers in their names, and the 3 x 3 or
    4 x 4 matrix of the one file whose name says ``intrinsic``. None where there are none.

    Raises FieldFormatError (CAMERAS_MALFORMED).
    """
    poses, intrinsics = [], None
    if len(files) > MOST_CAMERAS:
        raise malformed(f"more than {MOST_CAMERAS} files of poses")
    for name, data in sorted(files, key=lambda file: _order(file[0])):
        rows = _rows(name, data)
        if "intrinsic" in PurePosixPath(name).name.lower():
            if len(rows) < 3 or any(len(row) != len(rows[0]) or len(row) < 3 for row in rows):
                raise malformed(f"{name} holds no 3 x 3 matrix")
            intrinsics = np.array(rows, np.float64)[:3, :3]
        elif len(rows) in (3, 4) and all(len(row) == 4 for row in rows):
            poses.append(np.array([*rows, [0.0, 0.0, 0.0, 1.0]][:4], np.float64))
    return (np.stack(poses) if poses else None), intrinsics


def _rows(name: str, data: bytes | memoryview, most: int = MOST_BYTES) -> list[list[float]]:
    """The lines' numbers; NaN and infinity are such, as trackers write them for a camera that they have lost."""
    lines = (line.strip() for line in decoded(name, data, most).splitlines())
    words = [words_of(line) for line in lines if line and not line.startswith("#")]
    if len(words) > 1 and _NAMES_FIRST.match(words[0][0]):  # what the columns are
        del words[0]
    if words and not _STARTS.match(words[0][0]):  # a text of something else
        return []
    return [[_number(name, word) for word in line] for line in words]


def words_of(line: str) -> list[str]:
    """A line's numbers. A spreadsheet that writes decimal commas parts them by semicolons or tabs."""
    cells = _CELLS.split(line)
    if len(cells) > 1 and "." not in line and all(cell.count(",") <= 1 for cell in cells):
        line = line.replace(",", ".")
    return [word for word in _SEPARATORS.split(line) if word]


def _number(name: str, word: str) -> float:
    try:
        if len(word) <= MAX_NUMBER_CHARACTERS:
            return number(word.encode())
    except ValueError:
        pass
    raise malformed(f"{name}: {word[:MAX_NUMBER_CHARACTERS]!r} is not a number")


def _order(name: str) -> tuple[list[int], str]:
    return [int(number[:18]) for number in _NUMBERS.findall(PurePosixPath(name).name)[:8]], name


_ARRAY_BYTES = 64 << 20
_OPEN3D_SIZE = ("intrinsic.width", "intrinsic.height")
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
        message = (
            f"no cameras in {names}: expected transforms.json, meta_data.json, lines of TUM, EuRoC or KITTI, a "
            f"trajectory of Open3D, COLMAP's text model, or one matrix per file"
        )
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
        if looks_like_json(file.data) or bytes(file.data[:64]).lstrip()[:2] == b"[{":
            keys = Keys(name, read_json(name, file.data, lost=True))
            if isinstance(keys.tree, list):
                return _of_list(keys)
            if is_trajectory(keys):
                return read_trajectory_json(keys, _said(said), said.axes)
            if (found := _of_open3d(keys, said)) is not None:
                return found
    return _of_colmap(files) or _of_text(files, said)


def _rank(name: str) -> tuple[int, str]:
    """Known names first."""
    known = PurePosixPath(name).name
    return (_KNOWN_NAMES.index(known) if known in _KNOWN_NAMES else len(_KNOWN_NAMES)), name


def _of_list(keys: Keys) -> Trajectory:
    """The cameras.json of 3DGS: a list of cameras, each with its place and its axes in the world, OpenCV's."""
    if len(keys.tree) > MOST_CAMERAS:
        raise malformed(f"{keys.file} lists more than {MOST_CAMERAS} cameras")
    poses, intrinsics = [], []
    for index, one in enumerate(keys.tree):
        camera = Keys(keys.file, one, f"{index}.")
        rows, place = camera.matrix("rotation", 3, 3), camera.numbers("position")
        sizes = [camera.number(name) for name in ("fx", "fy", "width", "height")]
        if rows is None or place is None or len(place) != 3 or None in sizes:
            raise malformed(f"{keys.file}: camera {index} has no rotation, position, fx, fy, width or height")
        fx, fy, width, height = (float(size or 0.0) for size in sizes)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rows, place
        poses.append(pose)
        intrinsics.append(Intrinsics(fx, fy, width / 2, height / 2, width, height))
    if not poses:
        raise malformed(f"{keys.file} has no camera pose")
    return trajectory_of(keys.file, np.stack(poses), intrinsics, None)


def open3d_poses(tree: Any) -> Array | None:
    """The poses (N, 4, 4), camera to world, of Open3D's trajectory or pose graph, whose matrices are by columns."""
    for key, member in (("parameters", "extrinsic"), ("nodes", "pose")):
        listed = tree.get(key) if isinstance(tree, dict) else None
        if isinstance(listed, list) and listed and all(isinstance(one, dict) and member in one for one in listed):
            try:
                poses = np.array([one[member] for one in listed], np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
                return np.asarray(np.linalg.inv(poses) if member == "extrinsic" else poses, np.float64)
            except (TypeError, ValueError, np.linalg.LinAlgError):
                return None
    return None


def _of_open3d(keys: Keys, said: CamerasDescription) -> Trajectory | None:
    if (poses := open3d_poses(keys.tree)) is None:
        return None
    first = Keys(keys.file, (keys.tree.get("parameters") or [{}])[0], "parameters.0.")
    K, width, height = first.numbers("intrinsic.intrinsic_matrix"), *map(first.number, _OPEN3D_SIZE)
    found = Intrinsics(K[0], K[4], K[6], K[7], width, height) if K and len(K) == 9 and width and height else None
    if (known := _said(said) or found) is None:
        raise without_intrinsics(keys.file)
    return trajectory_of(keys.file, poses, known, said.axes or "opencv")


def colmap_lines(text: str, is_images: bool) -> list[list[str]]:
    """The words of each camera, or of each image, of COLMAP's text model; a line of points follows each image."""
    lines = [line.strip() for line in text.split("\n") if not line.startswith("#")]
    words = (line.split(maxsplit=9 if is_images else -1) for line in (lines[::2] if is_images else lines))
    return [line for line in words if line]


def _of_colmap(files: Sequence[SettingsFile]) -> Trajectory | None:
    """COLMAP's model as text: cameras.txt, and images.txt with world-to-camera quaternions, w first."""
    named = {PurePosixPath(file.name).name: file for file in files}
    if not {"cameras.txt", "images.txt"} <= named.keys():
        return None
    listed, images = (
        colmap_lines(decoded(name, named[name].data, _ARRAY_BYTES), name == "images.txt")
        for name in ("cameras.txt", "images.txt")
    )
    cameras: dict[str, Intrinsics] = {}
    for one, model, *sizes in (line for line in listed if len(line) > 7 - ("SIMPLE" in line[1])):
        if not _PINHOLES.fullmatch(model):
            message = f"cameras.txt: cameras of the model {model[:40]} are not supported"
            raise FieldFormatError(message, reason="CAMERAS_NOT_SUPPORTED")
        width, height, fx, *rest = (_number("cameras.txt", word) for word in sizes)
        fy, cx, cy = (fx, *rest[:2]) if model.startswith(("SIMPLE", "RADIAL")) else rest[:3]
        cameras[one] = Intrinsics(fx, fy, cx, cy, width, height)
    if not images or any(len(line) < 10 or line[8] not in cameras for line in images):
        raise malformed("images.txt is not a list of images of the cameras in cameras.txt")
    values = np.array([[_number("images.txt", word) for word in line[1:8]] for line in images])
    poses = np.linalg.inv(poses_of(values[:, 4:], np.roll(values[:, :4], -1, axis=1)))
    return trajectory_of("images.txt", np.asarray(poses, np.float64), [cameras[line[8]] for line in images], None)


def _of_text(files: Sequence[SettingsFile], said: CamerasDescription) -> Trajectory | None:
    texts = [(file.name, file.data) for file in files if not file.name.lower().endswith((".json", ".npz"))]
    if not texts:
        return None
    poses, matrix = read_matrices(texts)
    name = texts[0][0] if len(texts) == 1 else "the folder of poses"
    if poses is None:
        found = [(lines, file) for file, data in texts if (lines := read_lines(file, data)) is not None]
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
            raise malformed(f"{name}: world_mat_{index} is not a camera projection")
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
