"""Recordings whose poses are text: TUM RGB-D, 7-Scenes, Redwood, ScanNet, Replica, and a frame alone.

Facts of each layout are those of its own documentation. Sensors count pixel centers as whole numbers.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from regnf_core.errors import DatasetError, FieldFormatError
from regnf_core.importing.containers.plain_text import number
from regnf_core.importing.observing import reading
from regnf_core.importing.observing.reading import open3d_poses, read_lines, words_of
from regnf_core.texts import TextError, decode_text
from regnf_data.recordings.camera import Array, Camera, CameraFile, camera_of, of_color, read_camera_file
from regnf_data.recordings.recording import (
    DepthFile,
    Recording,
    StoredFrame,
    checked_size,
    color_file,
    pose_of,
    recording_of,
    whole_numbers,
)
from regnf_data.sdfstudio import ARRAYS, array_file

if TYPE_CHECKING:
    from regnf_data.recordings.recording import Given

_INVALID = "DATASET_METADATA_INVALID"
_MILLIMETER = 0.001
_MOST_TEXT = 256 << 20
DEPTHS = (".png", ".tif", ".tiff", ".pgm", *ARRAYS)
_FEWEST_PIXELS = 16
"""Along a side of an image."""
_COLORS = (".jpg", ".jpeg", ".png", ".ppm", ".bmp", ".webp")
_CAMERAS = (".json", ".txt", ".yaml", ".yml", ".csv", ".npy")
_POSE_LISTS = (".txt", ".csv", ".npy")
_NUMBER = re.compile(r"\d+")


# TUM RGB-D: time stamps and file names in lists, poses with time stamps.

_TUM_CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""fx fy cx cy as the benchmark publishes them, by the part of the folder's name; its lists have no intrinsics."""
_TUM_STEP_M = 1.0 / 5000.0
_NANOSECONDS = 1e15
"""Time stamps beyond are no seconds."""
_MOST_APART_S = 0.05
"""Between an image and the poses on both sides of it, or the color beside it."""


_ASSOCIATIONS = ("associations.txt", "associate.txt", "association.txt")
"""Lists of pairs, as ORB-SLAM needs them: a time stamp and an image, twice a line."""


def is_tum(path: Path) -> bool:
    listed = ("depth.txt", *_ASSOCIATIONS)
    return path.is_dir() and any((path / name).is_file() for name in listed) and _tum_poses(path) is not None


def _tum_poses(folder: Path) -> Path | None:
    names = ("groundtruth.txt", "trajectory.txt", "poses.txt", "CameraTrajectory.txt")
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read_tum(folder: Path, given: Given) -> Recording:
    """Poses between time stamps are interpolated."""
    published = next((value for part, value in _TUM_CAMERAS.items() if part in folder.resolve().name), None)
    note = "the folder has no intrinsics: the published ones of the benchmark are used"
    camera, unit, notes = _camera_of(folder.name, camera_beside(folder), given, _TUM_STEP_M, published, note)
    depths, colors = _tum_lists(folder)
    color_stamps = np.array([stamp for stamp, _ in colors])
    wanted = np.array([stamp for stamp, _ in depths])
    stamps, poses = _tum_trajectory(_tum_poses(folder) or folder / "groundtruth.txt", wanted)
    placed = interpolated(stamps, poses, wanted)
    if depths and not any(pose is not None for pose in placed):
        first, last = depths[0][0], depths[-1][0]
        raise DatasetError(
            f"{folder.name}: the images are from {first:.2f} to {last:.2f} s, the poses from {stamps[0]:.2f} to"
            f" {stamps[-1]:.2f} s: no image has a pose",
            reason="DATASET_NO_FRAMES",
        )
    frames: list[StoredFrame | None] = []
    for (stamp, name), pose in zip(depths, placed, strict=True):
        color = None
        if len(color_stamps):
            nearest = int(np.abs(color_stamps - stamp).argmin())
            beside = folder / colors[nearest][1]
            if abs(color_stamps[nearest] - stamp) <= _MOST_APART_S and beside.is_file():
                color = beside
        depth = folder / name
        frames.append(frame_of(Path(name).stem, camera, pose, depth if depth.is_file() else None, unit, color))
    return recording_of(folder.name, "TUM RGB-D", frames, notes)


def _tum_lists(folder: Path) -> tuple[list[tuple[float, str]], list[tuple[float, str]]]:
    """Time stamps and names of the depth and of the color images."""
    if (folder / "depth.txt").is_file():
        return _tum_list(folder / "depth.txt"), _tum_list(folder / "rgb.txt")
    path = next(folder / name for name in _ASSOCIATIONS if (folder / name).is_file())
    rows = [line.split() for line in _lines(path)]
    if not rows or any(len(row) != 4 for row in rows):
        raise DatasetError(f"{path.name}: expected lines of a time stamp and an image, twice", reason=_INVALID)
    halves = [[(_number(row[at], path.name), row[at + 1].replace("\\", "/")) for row in rows] for at in (0, 2)]
    first = "depth" in rows[0][1].lower()
    return (halves[0], halves[1]) if first else (halves[1], halves[0])


def _tum_list(path: Path) -> list[tuple[float, str]]:
    found = []
    for line in _lines(path) if path.is_file() else ():
        words = line.split(maxsplit=1)
        if len(words) == 2:
            stamp = _number(words[0], path.name)
            found.append((1e-9 * stamp if stamp > _NANOSECONDS else stamp, words[1].replace("\\", "/")))
    return found


def _tum_trajectory(path: Path, wanted: Array) -> tuple[Array, Array]:
    """Time stamps (N,), rising, and poses (N, 4, 4). wanted: of the depth images, for poses without stamps.

    Also as EuRoC has it (ns, p, q w first, and more), and as KITTI does (12 numbers a line, in the images' order).
    """
    rows = matrix_file(path)
    lengths = {len(row) for row in rows}
    if lengths in ({12}, {16}) and len(rows) == len(wanted):
        found = [pose_of(row, path.name) for row in rows]
        known = [number for number, pose in enumerate(found) if pose is not None]
        return wanted[known], np.array([found[number] for number in known])
    if len(lengths) == 1 and min(lengths) >= 8 and rows[0][0] > _NANOSECONDS:
        w_first = "," in next(iter(_lines(path)))  # EuRoC's tables; others have but other time stamps
        rows = [[1e-9 * row[0], *row[1:4], *((*row[5:8], row[4]) if w_first else row[4:8])] for row in rows]
        lengths = {8}
    if lengths != {8}:
        expected = "lines of t tx ty tz qx qy qz qw, or 12 numbers for each depth image"
        raise DatasetError(f"{path.name}: expected {expected}", reason=_INVALID)
    values = np.array(rows)
    values = values[np.isfinite(values).all(axis=1) & values[:, 4:].any(axis=1)]  # zeros: a tracker was lost
    values = values[np.argsort(values[:, 0], kind="stable")]
    if not len(values):
        raise DatasetError(f"{path.name}: no pose has finite numbers", reason="DATASET_NO_FRAMES")
    return values[:, 0], poses_of(values[:, 1:4], values[:, 4:], path.name)


def poses_of(places: Array, quaternions: Array, name: str) -> Array:
    """(N, 4, 4) of places (N, 3) and quaternions (N, 4), x y z w. Raises DatasetError (DATASET_POSE_NOT_RIGID)."""
    lengths = np.linalg.norm(quaternions, axis=1)
    if (odd := np.flatnonzero(~(np.abs(lengths - 1.0) <= 0.05))).size:
        said = f"{name}: the quaternion of pose {odd[0]} has the length {lengths[odd[0]]:.3g}, not 1"
        raise DatasetError(said, reason="DATASET_POSE_NOT_RIGID")
    return reading.poses_of(places, quaternions)


def interpolated(stamps: Array, poses: Array, wanted: Array) -> list[Array | None]:
    """Poses at the times ``wanted`` (M,), s, between those at ``stamps`` (N,); None where the nearest are too far."""
    from scipy.spatial.transform import Rotation, Slerp

    keep = np.concatenate([[True], np.diff(stamps) > 0.0])
    stamps, poses = stamps[keep], poses[keep]
    after = np.searchsorted(stamps, wanted)
    sides = stamps[np.maximum(after - 1, 0)], stamps[np.minimum(after, len(stamps) - 1)]
    gaps = np.minimum(*(np.abs(side - wanted) for side in sides))
    found = np.tile(poses[:1], (len(wanted), 1, 1))
    if len(stamps) > 1:
        inside = np.clip(wanted, stamps[0], stamps[-1])
        found[:, :3, :3] = Slerp(stamps, Rotation.from_matrix(poses[:, :3, :3]))(inside).as_matrix()
        for axis in range(3):
            found[:, axis, 3] = np.interp(inside, stamps, poses[:, axis, 3])
    return [pose if gap <= _MOST_APART_S else None for pose, gap in zip(found, gaps, strict=True)]


# 7-Scenes, 3DMatch and others: frame-000000.depth.png, .color.png, .pose.txt in one folder.

_SEVEN_SCENES = 585.0, 585.0, 320.0, 240.0
"""fx fy cx cy that 7-Scenes publishes for its depth images; other data of this layout have a file of intrinsics."""


def is_seven_scenes(path: Path) -> bool:
    return path.is_dir() and any(path.glob("[!.]*.pose.txt"))


def read_seven_scenes(folder: Path, given: Given) -> Recording:
    """Millimeters; the largest number stands for none; poses lead from the camera to the world."""
    note = "the folder has no intrinsics: the published ones of 7-Scenes are used (585, 585, 320, 240)"
    camera, unit, notes = _camera_of(folder.name, camera_beside(folder), given, _MILLIMETER, _SEVEN_SCENES, note)
    frames = []
    for pose_file in sorted(folder.glob("[!.]*.pose.txt")):
        name = pose_file.name.removesuffix(".pose.txt")
        depth = _first_file(folder, (f"{name}.depth",), DEPTHS)
        pose = pose_of(matrix_file(pose_file), name)
        color = _first_file(folder, (f"{name}.color", f"{name}.rgb"), _COLORS)
        frames.append(frame_of(name, camera, pose, depth, unit, color))
    return recording_of(folder.name, "7-Scenes, 3DMatch", frames, notes)


# Redwood and Open3D: depth/, color/ or image/, a trajectory.

_DEPTH_FOLDERS = ("depth", "depths", "depth_images")
_POSE_FOLDERS = ("pose", "poses")
_PRIMESENSE = 525.0, 525.0, 319.5, 239.5
_COLOR_FOLDERS = ("color", "image", "rgb", "images", "colors")


def is_redwood(path: Path) -> bool:
    return path.is_dir() and _subfolder(path, _DEPTH_FOLDERS) is not None and _trajectory_file(path) is not None


def _trajectory_file(folder: Path) -> Path | None:
    places = [p for pattern in ("[!.]*", "scene/[!.]*") for p in sorted(folder.glob(pattern))]
    lists = [p for p in places if re.search(r"traj|pose|odometry", p.name) and p.suffix in (".json", *_POSE_LISTS)]
    return next((p for p in [*(p for p in places if p.suffix == ".log"), *lists] if p.is_file()), None)


def read_redwood(folder: Path, given: Given) -> Recording:
    """A trajectory has a frame's numbers, then its pose to the world in four rows; images are in their order. Also
    lists of a pose a line: a matrix, or Stray Scanner's time stamp, frame, place and quaternion."""
    path = _trajectory_file(folder)
    depths = _subfolder(folder, _DEPTH_FOLDERS)
    if path is None or depths is None:
        raise DatasetError(f"{folder.name} has no depth/ or no trajectory", reason="DATASET_NO_METADATA")
    note = "the folder has no intrinsics: those of the PrimeSense camera (Open3D's default) are used"
    camera, unit, notes = _camera_of(folder.name, camera_beside(folder), given, _MILLIMETER, _PRIMESENSE, note)
    if path.name == "odometry.csv" and camera.size is None:  # of Stray Scanner's video
        camera = replace(camera, size=(1440, 1920))
    colors = _subfolder(folder, _COLOR_FOLDERS)
    poses = _redwood_poses(path)
    images = in_order(depths, DEPTHS)
    pictures = in_order(colors, _COLORS) if colors else []
    matched = len(pictures) == len(images)
    if len(poses) > len(images):
        raise DatasetError(
            f"{path.name} has {len(poses)} poses, {depths.name} {len(images)} images", reason="DATASET_SIZES_DIFFER"
        )
    frames = []
    for index, image in enumerate(images):
        pose = pose_of(poses[index], image.stem) if index in poses else None
        frames.append(frame_of(image.stem, camera, pose, image, unit, pictures[index] if matched else None))
    return recording_of(folder.name, "Redwood, Open3D", frames, notes)


def _redwood_poses(path: Path) -> dict[int, Any]:
    poses: dict[int, Any] = {}
    if path.suffix == ".log":
        lines = list(_lines(path))
        if len(lines) % 5:
            raise DatasetError(f"{path.name}: expected five lines per pose", reason=_INVALID)
        for at in range(0, len(lines), 5):
            number = int(_number(lines[at].split()[0], path.name))
            poses[number] = [[_number(word, path.name) for word in line.split()] for line in lines[at + 1 : at + 5]]
        return poses
    if path.suffix == ".npy":
        return dict(enumerate(matrix_file(path)))
    try:
        is_text = path.suffix != ".json"
        found = read_lines(path.name, path.read_bytes(), _MOST_TEXT) if is_text else open3d_poses(read_json(path))
    except FieldFormatError as error:
        raise DatasetError(str(error), reason=_INVALID) from error
    if found is None:
        said = f"{path.name}: expected one pose per line, 12 or 16 numbers, or Open3D's trajectory or pose graph"
        raise DatasetError(said, reason=_INVALID)
    return dict(enumerate(found))


# ScanNet, extracted: color/0.jpg, depth/0.png, pose/0.txt, intrinsic/.


def is_scannet(path: Path) -> bool:
    return path.is_dir() and None not in (_subfolder(path, _POSE_FOLDERS), _subfolder(path, _DEPTH_FOLDERS))


def read_scannet(folder: Path, given: Given) -> Recording:
    """Millimeters; color and depth have cameras of their own; rows of -inf are lost frames."""
    depths, colors = _subfolder(folder, _DEPTH_FOLDERS) or folder / "depth", _subfolder(folder, _COLOR_FOLDERS)
    found = _named_camera(folder, "intrinsic_depth") or camera_beside(folder)
    camera, unit, _ = _camera_of(folder.name, found, given, _MILLIMETER)
    of_color = _named_camera(folder, "intrinsic_color")
    frames = []
    files = in_order(_subfolder(folder, _POSE_FOLDERS) or folder, (".txt", ".npy"))
    for pose_file in [file for file in files if _NUMBER.search(file.stem)] or files:  # and no readme.txt
        name = pose_file.stem
        depth = _first_file(depths, (name,), DEPTHS)
        color = _first_file(colors, (name,), _COLORS) if colors else None
        pose = pose_of(matrix_file(pose_file), name)
        frames.append(frame_of(name, camera, pose, depth, unit, color, of_color.camera if of_color else None))
    return recording_of(folder.name, "ScanNet, extracted", frames)


def _named_camera(folder: Path, name: str) -> CameraFile | None:
    path = next((p for p in (folder / "intrinsic" / f"{name}.txt", folder / f"{name}.txt") if p.is_file()), None)
    return read_camera_file(path) if path else None


# Replica as NICE-SLAM renders it: results/frame000000.jpg, results/depth000000.png, traj.txt, cam_params.json.


def is_replica(path: Path) -> bool:
    return path.is_dir() and (path / "traj.txt").is_file() and any((path / "results").glob("depth*"))


def read_replica(folder: Path, given: Given) -> Recording:
    """A line of traj.txt is a pose to the world, 16 numbers. The intrinsics lie in the folder or the one above it."""
    found = camera_beside(folder) or camera_beside(folder.resolve().parent)
    camera, unit, _ = _camera_of(folder.name, found, given, 1.0 / 6553.5)
    images = in_order(folder / "results", DEPTHS, "depth")
    poses = matrix_file(folder / "traj.txt")
    if len(poses) != len(images):
        raise DatasetError(
            f"traj.txt has {len(poses)} poses, results {len(images)} depth images", reason="DATASET_SIZES_DIFFER"
        )
    frames = []
    for row, image in zip(poses, images, strict=True):
        pose = pose_of(row, image.stem)
        color = _first_file(folder / "results", (image.stem.replace("depth", "frame"),), _COLORS)
        frames.append(frame_of(image.stem, camera, pose, image, unit, color))
    return recording_of(folder.name, "Replica (NICE-SLAM)", frames)


# One frame: a depth image, a file of intrinsics, and perhaps a color image; or the depth image itself.


def is_frame(path: Path) -> bool:
    return _frame_files(path) is not None


def _frame_files(path: Path) -> tuple[Path, Path | None] | None:
    """The depth image and the color image; None where there is no one depth image."""
    if path.is_file():
        known = path.suffix.lower() in DEPTHS and (path.suffix.lower() not in ARRAYS or _is_image(path))
        return (path, None) if known else None
    images = [p for p in sorted(path.glob("[!.]*")) if p.suffix.lower() in (*DEPTHS, *_COLORS) and p.is_file()]
    named = [p for p in images if "depth" in p.name.lower() and p.suffix.lower() in DEPTHS]
    depths = named or [p for p in images if p.suffix.lower() in ARRAYS or _has_16_bits(p)]
    if len(depths) != 1:
        return None
    colors = [p for p in images if p != depths[0] and p.suffix.lower() in _COLORS and "mask" not in p.name.lower()]
    named = [p for p in colors if re.search("colou?r|rgb|image", p.name.lower())]
    chosen = named if named else colors
    return depths[0], chosen[0] if len(chosen) == 1 else None


def _is_image(path: Path) -> bool:
    """Whether a file's array is one of pixels: a grid of distances and a list of points are none."""
    try:
        shape = array_file(path).shape
    except DatasetError:
        return False
    return len(shape) == 2 and min(shape) >= _FEWEST_PIXELS


def _has_16_bits(path: Path) -> bool:
    try:
        with Image.open(path) as image:
            return image.mode.startswith("I") or image.mode == "F"
    except (OSError, ValueError, SyntaxError):
        return False


def read_frame(path: Path, given: Given) -> Recording:
    """The camera's frame is the world, unless the file of intrinsics says T_world_camera."""
    files = _frame_files(path)
    if files is None:
        raise DatasetError(f"{path.name} has no depth image", reason="DATASET_NO_FRAMES")
    depth, color = files
    folder = path if path.is_dir() else path.parent
    found = camera_beside(folder) if path.is_dir() or given.camera is None else None
    camera, unit, _ = _camera_of(path.name, found, given, _MILLIMETER)
    stated = given.depth_unit or (found and found.depth_unit)
    guessed = not stated and whole_numbers(depth)
    notes = ["the depth unit is not in any file: millimeters are assumed"] if guessed else []
    # A camera file of the color image's resolution is scaled to the depth image's.
    size = checked_size(depth)
    pose = np.eye(4) if found is None or found.pose is None else pose_of(found.pose, "T_world_camera")
    frame = frame_of(depth.stem, camera.of_size(size, depth.name), pose, depth, unit, color)
    return recording_of(path.name, "one frame", [frame], notes)


# What they share.


def camera_beside(folder: Path) -> CameraFile | None:
    """The camera of a file of the folder whose name says so; the first that holds intrinsics."""
    pattern = re.compile(r"^[^.].*(intrinsic|camera|calib)|^(intrinsic|calib|cam)|^k\.(txt|npy)$", re.IGNORECASE)
    places = [
        folder,
        *(folder / name for name in ("intrinsic", "intrinsics", "calibration") if (folder / name).is_dir()),
    ]
    for place in places:
        for path in sorted(place.iterdir(), key=lambda one: (of_color(one.name), one.name)):
            if pattern.search(path.name) and path.suffix.lower() in _CAMERAS and path.is_file():
                found = read_camera_file(path)
                if found is not None:
                    return found
    return None


def _camera_of(
    name: str,
    found: CameraFile | None,
    given: Given,
    unit: float,
    published: tuple[float, float, float, float] | None = None,
    note: str = "",
) -> tuple[Camera, float, list[str]]:
    """The camera and the meters a step: those given, else those of the file ``found``, else the layout's.

    published: fx fy cx cy of the layout's cameras, taken with this note. Raises DatasetError without any camera.
    """
    unit = given.depth_unit or (found.depth_unit if found else None) or unit
    if camera := given.camera or (found.camera if found else None):
        return camera, unit, []
    if published is None:
        raise DatasetError(
            f"{name} has no intrinsics: no file named camera or intrinsics there has fx, fy, cx, cy or a matrix K. "
            f"Write one, or give --intrinsics fx,fy,cx,cy",
            reason="DATASET_INTRINSICS_INVALID",
        )
    return camera_of(*published, size=(480, 640), whole_centers=True), unit, [note]


def frame_of(
    name: str,
    camera: Camera,
    pose: Array | None,
    depth: Path | None,
    unit: float | None,
    color: Path | None,
    color_camera: Camera | None = None,
) -> StoredFrame | None:
    """A frame of image files; None where it has no pose or no depth."""
    if pose is None or depth is None:
        return None
    return StoredFrame(name, camera, pose, DepthFile(depth, unit), color_file(color) if color else None, color_camera)


def matrix_file(path: Path) -> list[list[float]]:
    """The numbers of a text file, by rows. Raises DatasetError (DATASET_METADATA_INVALID)."""
    if path.suffix == ".npy":
        values = array_file(path)
        return [row.ravel().tolist() for row in (values if values.ndim > 1 else values[None])]
    lines = [words for line in _lines(path) if (words := words_of(line))]
    if len(lines) > 1 and lines[0][0].lower() in ("timestamp", "time", "frame", "x", "tx"):  # what the columns are
        del lines[0]
    return [[_number(word, path.name) for word in words] for words in lines]


def read_json(path: Path) -> Any:
    """Raises DatasetError (DATASET_METADATA_INVALID, DATASET_TOO_LARGE)."""
    if path.stat().st_size > _MOST_TEXT:
        raise DatasetError(f"{path.name} has more than {_MOST_TEXT} bytes", reason="DATASET_TOO_LARGE")
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path.name} is not JSON: {error}", reason=_INVALID) from error


def _lines(path: Path) -> Iterable[str]:
    """Without empty lines and comments."""
    if path.stat().st_size > _MOST_TEXT:
        raise DatasetError(f"{path.name} has more than {_MOST_TEXT} bytes", reason="DATASET_TOO_LARGE")
    try:
        text = decode_text(path.read_bytes())
    except TextError as error:
        raise DatasetError(f"{path.name} is {error}", reason=_INVALID) from error
    for line in text.split("\n"):
        if (stripped := line.strip()) and not stripped.startswith("#"):
            yield stripped


def _number(word: str, name: str) -> float:
    try:
        return number(word.encode())
    except ValueError as error:
        raise DatasetError(f"{name}: {word[:40]!r} is not a number", reason=_INVALID) from error


def _order(path: Path) -> tuple[list[int], str]:
    """Frames by the numbers in their names."""
    return [int(number[:18]) for number in _NUMBER.findall(path.stem)[:8]], path.name


def in_order(folder: Path, suffixes: Sequence[str], prefix: str = "") -> list[Path]:
    found = [p for p in folder.glob(f"{prefix or '[!.]'}*") if p.suffix.lower() in suffixes and p.is_file()]
    return sorted(found, key=_order)


def _first_file(folder: Path, stems: Iterable[str], suffixes: Sequence[str]) -> Path | None:
    names = (folder / f"{stem}{end}" for stem in stems for suffix in suffixes for end in (suffix, suffix.upper()))
    return next((path for path in names if path.is_file()), None)


def _subfolder(folder: Path, names: Sequence[str]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_dir()), None)
