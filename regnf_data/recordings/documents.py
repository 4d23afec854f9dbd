"""Recordings whose cameras are listed by a trainer or a benchmark: BOP, nerfstudio, sdfstudio, COLMAP.

Facts of each layout are those of its own documentation.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError
from regnf_core.importing.observing.reading import colmap_lines
from regnf_data.recordings.camera import HALF_A_PIXEL, Array, Camera, camera_of, lens_of
from regnf_data.recordings.folders import (
    _COLOR_FOLDERS,
    _COLORS,
    _DEPTH_FOLDERS,
    DEPTHS,
    _first_file,
    _lines,
    _subfolder,
    frame_of,
    poses_of,
    read_json,
)
from regnf_data.recordings.recording import MOST_PIXELS, Recording, StoredFrame, checked_size, pose_of, recording_of
from regnf_data.sdfstudio import resolve

if TYPE_CHECKING:
    from regnf_data.recordings.recording import Given

_INVALID = "DATASET_METADATA_INVALID"
_METRIC = 1e-3
"""How far the scale of a world in meters may be from 1."""
_INTRINSICS = "DATASET_INTRINSICS_INVALID"
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def _object(path: Path) -> dict[str, Any]:
    values = read_json(path)
    if not isinstance(values, dict):
        raise DatasetError(f"{path.name} is not a JSON object", reason=_INVALID)
    return values


# BOP: a scene's folder with scene_camera.json, depth/, rgb/ or gray/.


def is_bop(path: Path) -> bool:
    return (path / "scene_camera.json").is_file()


def read_bop(folder: Path, given: Given) -> Recording:
    """Translations in millimeters, world to camera; depth_scale millimeters a step. Scenes whose frames have no world
    pose are frames alone: each is its own world."""
    cameras = _object(folder / "scene_camera.json")
    depths, colors = folder / "depth", _subfolder(folder, ("rgb", "gray"))
    if not depths.is_dir():
        raise DatasetError(f"{folder.name} has no depth images, only color images", reason="DATASET_DEPTH_MISSING")
    frames: list[StoredFrame | None] = []
    unplaced = 0
    for key in sorted(cameras, key=lambda each: (not each.isdigit(), each.zfill(12))):
        values = cameras[key]
        name = key.zfill(6)
        if not isinstance(values, dict):
            raise DatasetError(f"scene_camera.json: {key} is not a camera", reason=_INVALID)
        camera = given.camera or _bop_camera(values, name)
        unit = given.depth_unit or 0.001 * float(values.get("depth_scale", 1.0))
        pose: Array | None = np.eye(4)
        if "cam_R_w2c" in values and "cam_t_w2c" in values:
            matrix = np.eye(4)
            try:
                matrix[:3, :3] = np.array(values["cam_R_w2c"], np.float64).reshape(3, 3)
                matrix[:3, 3] = np.array(values["cam_t_w2c"], np.float64)
            except (TypeError, ValueError) as error:
                raise DatasetError(
                    f"scene_camera.json: the pose of {key} is not 9 and 3 numbers", reason=_INVALID
                ) from error
            pose = pose_of(matrix, name, inverse=True, unit=0.001)
        else:
            unplaced += 1
        depth = _first_file(depths, (name, key), DEPTHS)
        color = _first_file(colors, (name, key), _COLORS) if colors else None
        frames.append(frame_of(name, camera, pose, depth, unit, color))
    notes = []
    if unplaced and len(cameras) > 1:
        notes.append(
            f"{unplaced} of {len(cameras)} frames have no pose in a common world frame: register in one frame at a time"
        )
    return recording_of(folder.name, "BOP", frames, notes)


def _bop_camera(values: Mapping[str, Any], name: str) -> Camera:
    try:
        K = np.array(values.get("cam_K"), np.float64).reshape(3, 3)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{name}: cam_K is not nine numbers", reason=_INTRINSICS) from error
    return Camera(K + HALF_A_PIXEL).check(name)


# nerfstudio: transforms.json with frames; its cameras look against z, y is up; pixel centers at one half.


def is_nerfstudio(path: Path) -> bool:
    return _transforms(path) is not None


def _transforms(path: Path) -> Path | None:
    if path.is_file():
        return path if path.name.startswith("transforms") and path.suffix == ".json" else None
    names = ("transforms.json", "transforms_train.json")
    return next((path / name for name in names if (path / name).is_file()), None)


def read_nerfstudio(path: Path, given: Given) -> Recording:
    """Depths are ``depth_unit_scale_factor`` (0.001) world units a step."""
    file = _transforms(path)
    if file is None:
        raise DatasetError(f"{path.name} has no transforms.json", reason="DATASET_NO_METADATA")
    values, folder = _object(file), file.parent
    listed = values.get("frames")
    if not isinstance(listed, list) or not all(isinstance(each, dict) for each in listed) or not listed:
        raise DatasetError(f"{file.name} lists no frames", reason="DATASET_NO_FRAMES")
    stated = values.get("depth_unit_scale_factor", values.get("integer_depth_scale", 0.001))  # the latter: instant-ngp
    unit = given.depth_unit or float(stated)
    named = [each for each in listed if each.get("depth_file_path") or each.get("depth_path")]
    if not named:
        raise DatasetError(
            f"{file.name} has no depth images (depth_file_path), which a map needs. Give one for each frame, next to "
            f"its file_path",
            reason="DATASET_DEPTH_MISSING",
        )
    frames: list[StoredFrame | None] = []
    for index, each in enumerate(listed):
        name = str(each.get("file_path", index))
        depth = each.get("depth_file_path") or each.get("depth_path")
        pose = pose_of(each.get("transform_matrix"), name)
        if pose is None or depth is None:
            frames.append(None)
            continue
        color = _color_path(folder, each.get("file_path"))
        stated = {**values, **each}
        if given.camera is None and color is not None and not ("w" in stated and "h" in stated):
            stated["h"], stated["w"] = checked_size(color)
        camera = given.camera or _nerfstudio_camera(stated, name)
        image = resolve(folder, depth, f"depth_file_path of {name}")
        frames.append(frame_of(name, camera, pose @ _OPENGL, image, unit, color))
    return recording_of(path.name, "nerfstudio", frames)


def _color_path(folder: Path, name: Any) -> Path | None:
    if not isinstance(name, str) or not name:
        return None
    path = (folder / name.replace("\\", "/")).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise DatasetError(f"file_path leaves the folder: {name!r:.200}", reason="DATASET_PATH_OUTSIDE")
    return path if path.is_file() else _first_file(path.parent, (path.name,), _COLORS)


_PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")


def _unsupported(name: str, model: str) -> DatasetError:
    said = f"{name}: cameras of the model {model[:40]} are not supported"
    return DatasetError(said, reason="DATASET_CAMERA_UNSUPPORTED")


def _nerfstudio_camera(values: Mapping[str, Any], name: str) -> Camera:
    model = str(values.get("camera_model", "OPENCV"))
    fisheye = model == "OPENCV_FISHEYE"
    if model not in _PINHOLES and not fisheye:
        raise _unsupported(name, model)
    try:
        width, height = (int(values[key]) if key in values else None for key in ("w", "h"))
        if "fl_x" in values:
            fx = float(values["fl_x"])
        elif width:
            fx = width / 2.0 / np.tan(float(values["camera_angle_x"]) / 2.0)
        else:
            raise KeyError("fl_x")
        fy = float(values.get("fl_y", fx))
        cx, cy = (
            float(values[key]) if key in values else side / 2.0
            for key, side in (("cx", width or 0), ("cy", height or 0))
        )
        keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        lens = lens_of([float(values.get(key, 0.0) or 0.0) for key in keys], fisheye, name)
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(
            f"{name}: the camera needs fl_x, fl_y, cx, cy, w and h as numbers: {error}", reason=_INTRINSICS
        ) from error
    size = (height, width) if width and height else None
    return camera_of(fx, fy, cx, cy, size, lens).check(name)


# sdfstudio: meta_data.json. The reader of fits knows it; frames of it are read one at a time here.


def is_sdfstudio(path: Path) -> bool:
    return (path / "meta_data.json").is_file()


def read_sdfstudio(folder: Path, given: Given) -> Recording:
    """Distances are the data set's own units, which ``worldtogt`` leads to meters."""
    from regnf_data import sdfstudio

    metadata = sdfstudio.read_metadata(folder)
    listed = sdfstudio.frames_of(metadata)
    stated = metadata.get("depth_unit_scale_factor")
    unit = given.depth_unit or (None if stated is None else float(stated))
    size = (int(metadata["height"]), int(metadata["width"])) if "height" in metadata and "width" in metadata else None
    given_metric = sdfstudio.worldtogt(metadata)
    T_metric_world = None if given_metric is None else sdfstudio.similarity(given_metric, "worldtogt", _INVALID)
    frames: list[StoredFrame | None] = []
    for index, each in enumerate(listed):
        depth = each.get("sensor_depth_path")
        name = PurePosixPath(str(each.get("rgb_path", index))).name
        pose = pose_of(each.get("camtoworld"), name)
        if pose is None or depth is None:
            frames.append(None)
            continue
        camera = given.camera or Camera(sdfstudio.intrinsics_of_frame(each, metadata, index), size).check(name)
        color = each.get("rgb_path")
        picture = resolve(folder, color, f"rgb_path of {name}") if color else None
        image = resolve(folder, depth, f"sensor_depth_path of {name}")
        frames.append(frame_of(name, camera, pose, image, unit, picture))
    scale = None if T_metric_world is None else np.cbrt(np.linalg.det(T_metric_world[:3, :3]))
    is_metric = scale is not None and abs(scale - 1.0) < _METRIC
    return recording_of(folder.name, "sdfstudio", frames, (), T_metric_world, is_metric)


# COLMAP: cameras and images, as text or binary, and a depth image of each image's name.


def is_colmap(path: Path) -> bool:
    return path.is_dir() and _model(path) is not None and _colmap_depths(path) is not None


def _model(folder: Path) -> Path | None:
    for place in (folder, folder / "sparse" / "0", folder / "sparse", folder / "colmap" / "sparse" / "0"):
        if any(
            (place / f"images.{kind}").is_file() and (place / f"cameras.{kind}").is_file() for kind in ("bin", "txt")
        ):
            return place
    return None


def _colmap_depths(folder: Path) -> Path | None:
    return _subfolder(folder, (*_DEPTH_FOLDERS, "stereo/depth_maps"))


def read_colmap(folder: Path, given: Given) -> Recording:
    """Poses lead from the world to the camera, in a unit of their own: depths must have it too, or the check of the
    frames says by which factor they differ. Depth images hold millimeters unless it is said; dense maps the unit."""
    model, depths = _model(folder), _colmap_depths(folder)
    if model is None or depths is None:
        raise DatasetError(
            f"{folder.name} has no cameras and images of COLMAP, or no depth/", reason="DATASET_NO_METADATA"
        )
    binary = (model / "images.bin").is_file() and (model / "cameras.bin").is_file()
    cameras = dict(_binary_cameras(model / "cameras.bin") if binary else _text_cameras(model / "cameras.txt"))
    images = list(_binary_images(model / "images.bin") if binary else _text_images(model / "images.txt"))
    colors = _subfolder(folder, _COLOR_FOLDERS)
    unit, is_dense = given.depth_unit or 0.001, False
    frames: list[StoredFrame | None] = []
    for name, number, quaternion, place in sorted(images, key=lambda each: each[0]):
        if number not in cameras:
            raise DatasetError(f"{name}: COLMAP's model has no camera {number}", reason=_INVALID)
        pose = np.linalg.inv(poses_of(place[None], quaternion[None], name)[0])
        path = PurePosixPath(name)
        depth = _first_file(depths, (str(path.with_suffix("")), name), DEPTHS)
        dense = (depths / f"{name}.{kind}.bin" for kind in ("geometric", "photometric"))
        depth = depth or next((path for path in dense if path.is_file()), None)
        color = None if colors is None or depth is None else _color_path(colors, name)
        frame = frame_of(name, given.camera or cameras[number], pose, depth, unit, color)
        if frame is not None and depth is not None and depth.suffix == ".bin":
            is_dense, frame = True, replace(frame, depth=partial(_dense, depth))
        frames.append(frame)
    return recording_of(folder.name, "COLMAP with depth", frames, is_metric=not is_dense)


def _dense(path: Path) -> NDArray[np.float32]:
    """COLMAP's own array: width&height&channels& and float32."""
    try:
        with path.open("rb") as file:
            head = b""
            while head.count(b"&") < 3 and len(head) < 64:
                head += file.read(1)
            width, height, channels = (int(part) for part in head.split(b"&")[:3])
            if not 0 < width * height <= MOST_PIXELS:
                raise ValueError(f"{width} x {height} pixels")
            values = np.fromfile(file, np.float32, width * height * channels)
            depth = values.reshape(height, width) if channels == 1 else None
    except ValueError as error:
        raise DatasetError(
            f"{path.name} is not a depth map of COLMAP: {error}", reason="DATASET_IMAGE_INVALID"
        ) from error
    if depth is None:
        raise DatasetError(f"{path.name} has {channels} channels", reason="DATASET_IMAGE_INVALID")
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0))


# Parameters: f (or fx fy) cx cy, then the lens, in OpenCV's order.
_COLMAP_MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12),
}  # fmt: skip


def _colmap_camera(model: str, size: tuple[int, int], numbers: list[float], name: str) -> Camera:
    single = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
    if model in ("FOV", "THIN_PRISM_FISHEYE") or model not in {each for each, _ in _COLMAP_MODELS.values()}:
        raise _unsupported(name, model)
    fx, fy, cx, cy = (numbers[0], *numbers[:3]) if single else numbers[:4]
    rest = numbers[3:] if single else numbers[4:]
    if model in ("SIMPLE_RADIAL", "RADIAL", "OPENCV"):
        rest = [*rest, 0.0, 0.0, 0.0, 0.0][:4]
    return camera_of(fx, fy, cx, cy, size, lens_of(rest, "FISHEYE" in model, name)).check(name)


def _text_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    for line in _lines(path):
        words = line.split()
        try:
            number, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            numbers = [float(word) for word in words[4:]]
            yield number, _colmap_camera(model, (height, width), numbers, f"camera {number}")
        except (IndexError, ValueError) as error:
            if isinstance(error, DatasetError):
                raise
            raise DatasetError(f"{path.name}: {line[:60]!r} is not a camera", reason=_INVALID) from error


Image = tuple[str, int, Array, Array]
"""Name, number of the camera, quaternion x y z w and translation, world to camera."""


def _text_images(path: Path) -> Iterator[Image]:
    for words in colmap_lines(path.read_text(encoding="utf-8", errors="replace"), is_images=True):
        try:
            w, x, y, z, *place = (float(word) for word in words[1:8])
            yield words[9], int(words[8]), np.array([x, y, z, w]), np.array(place)
        except (IndexError, ValueError) as error:
            raise DatasetError(f"{path.name}: {' '.join(words)[:60]!r} is not an image", reason=_INVALID) from error


def _unpack(file: BinaryIO, form: str, name: str) -> tuple[Any, ...]:
    size = struct.calcsize(f"<{form}")
    data = file.read(size)
    if len(data) < size:
        raise DatasetError(f"{name} ends too early", reason=_INVALID)
    return struct.unpack(f"<{form}", data)


def _binary_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    with path.open("rb") as file:
        (count,) = _unpack(file, "Q", path.name)
        for _ in range(count):
            number, model, width, height = _unpack(file, "iiQQ", path.name)
            if model not in _COLMAP_MODELS:
                raise DatasetError(
                    f"{path.name}: the camera model {model} is not known", reason="DATASET_CAMERA_UNSUPPORTED"
                )
            name, parameters = _COLMAP_MODELS[model]
            numbers = list(_unpack(file, f"{parameters}d", path.name))
            yield number, _colmap_camera(name, (height, width), numbers, f"camera {number}")


def _binary_images(path: Path) -> Iterator[Image]:
    with path.open("rb") as file:
        (count,) = _unpack(file, "Q", path.name)
        for _ in range(count):
            _, w, x, y, z, *place, camera = _unpack(file, "i7di", path.name)
            name = bytearray()
            while (byte := file.read(1)) not in (b"\0", b""):
                name += byte
            (points,) = _unpack(file, "Q", path.name)
            file.seek(24 * points, 1)
            yield name.decode("utf-8", "replace"), camera, np.array([x, y, z, w]), np.array(place)
