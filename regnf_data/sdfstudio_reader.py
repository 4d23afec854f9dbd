"""Reads a folder in the sdfstudio data format."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError
from regnf_data.image_files import Size, image_size, read_colors, read_depth, read_mask, resolve
from regnf_data.instances import read_instances
from regnf_data.json_values import array, rigid, similarity, whole_number
from regnf_data.posed_images import PosedImages

METADATA = "meta_data.json"
_INVALID = "DATASET_METADATA_INVALID"
_INTRINSICS = "DATASET_INTRINSICS_INVALID"
_CAMERAS = ("OPENCV", "PINHOLE")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_MAX_BYTES = 64 << 20
_MAX_PIXELS = 1 << 30
USUAL_BOUNDS = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
"""sdfstudio's own: scenes are scaled into this cube."""


def load_dataset(folder: str | os.PathLike[str], opengl: bool = False) -> PosedImages:
    """The images of a folder with ``meta_data.json``, in the folder's world frame. Frames whose pose is not finite, of
    a camera that was lost, are left out. opengl: its cameras look against z, y is up.

    Frames need ``rgb_path``, ``camtoworld`` and ``intrinsics`` (their own, or one for all beside ``frames``);
    everything else may be absent, see docs/datasets.md.
    Raises DatasetError: DATASET_NO_METADATA, DATASET_METADATA_INVALID, DATASET_CAMERA_UNSUPPORTED, DATASET_NO_FRAMES,
    DATASET_POSE_NOT_RIGID, DATASET_INTRINSICS_INVALID, DATASET_IMAGE_MISSING, DATASET_IMAGE_INVALID,
    DATASET_SIZES_DIFFER, DATASET_DEPTH_UNIT_MISSING, DATASET_PATH_OUTSIDE, DATASET_INSTANCE_INVALID, DATASET_TOO_LARGE.
    """
    root = Path(folder)
    metadata = _metadata(root)
    _check_camera(metadata)
    frames = _frames(metadata)
    size = _size(metadata, root, frames)
    # What lies in the metadata comes first: it is refused before any image is decoded.
    intrinsics = np.stack([_intrinsics(frame, metadata, index) for index, frame in enumerate(frames)])
    poses = [rigid(f.get("camtoworld"), f"camtoworld of frame {i}", _pose_reason(f)) for i, f in enumerate(frames)]
    bounds = _bounds(metadata)
    instances = read_instances(metadata.get("instances"))
    return PosedImages(
        colors=_colors(root, frames, size),
        intrinsics=intrinsics,
        T_world_camera=np.stack(poses) * np.array((1.0, -1.0, -1.0, 1.0) if opengl else 1.0),
        bounds=bounds,
        depths=_depths(root, metadata, frames, size),
        masks=_masks(root, metadata, frames, size),
        instances=instances,
        T_metric_world=_metric_world(metadata),
    )


def _metadata(folder: Path) -> dict[str, Any]:
    path = folder / METADATA
    if not path.is_file():
        raise DatasetError(f"{folder.name} holds no {METADATA}", reason="DATASET_NO_METADATA")
    if path.stat().st_size > _MAX_BYTES:
        raise DatasetError(f"{METADATA} has more than {_MAX_BYTES} bytes", reason="DATASET_TOO_LARGE")
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{METADATA} is not JSON: {error}", reason=_INVALID) from error
    if not isinstance(content, dict):
        raise DatasetError(f"{METADATA} is not a JSON object", reason=_INVALID)
    return content


def _check_camera(metadata: dict[str, Any]) -> None:
    model = metadata.get("camera_model", "OPENCV")
    if model not in _CAMERAS:
        raise DatasetError(
            f"camera model {model!r:.80}: only {', '.join(_CAMERAS)}", reason="DATASET_CAMERA_UNSUPPORTED"
        )
    if any(metadata.get(name) not in (None, 0, 0.0) for name in _DISTORTION):
        raise DatasetError("lenses that distort: undistort the images", reason="DATASET_CAMERA_UNSUPPORTED")


def _frames(metadata: dict[str, Any]) -> list[dict[str, Any]]:
    frames = metadata.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DatasetError("the metadata lists no frames", reason="DATASET_NO_FRAMES")
    if not all(isinstance(frame, dict) for frame in frames):
        raise DatasetError("a frame is not a JSON object", reason=_INVALID)
    found = [frame for frame in frames if not _lost(frame.get("camtoworld"))]
    if not found:
        raise DatasetError("no frame has a pose of finite numbers", reason="DATASET_POSE_NOT_RIGID")
    return found


def _lost(pose: Any) -> bool:
    """Whether a pose has the right shape, and numbers that are not finite."""
    try:
        numbers = np.array(pose, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return False
    return numbers.shape in ((4, 4), (3, 4)) and not np.isfinite(numbers).all()


def _size(metadata: dict[str, Any], folder: Path, frames: list[dict[str, Any]]) -> Size:
    stated = (metadata.get("height"), metadata.get("width"))
    if None in stated:
        height, width = image_size(resolve(folder, frames[0].get("rgb_path"), "rgb_path of frame 0"))
    else:
        height, width = (
            whole_number(value, name, _INVALID) for value, name in zip(stated, ("height", "width"), strict=True)
        )
    if len(frames) * height * width > _MAX_PIXELS:
        raise DatasetError(
            f"{len(frames)} images of {height} x {width}: more than {_MAX_PIXELS} pixels", reason="DATASET_TOO_LARGE"
        )
    return height, width


def _intrinsics(frame: dict[str, Any], metadata: dict[str, Any], index: int) -> NDArray[np.float64]:
    given = frame.get("intrinsics", metadata.get("intrinsics"))
    matrix = array(given, ((4, 4), (3, 3), (3, 4)), f"intrinsics of frame {index}", _INTRINSICS)[:3, :3]
    upright = np.allclose(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], (0.0, 0.0, 0.0, 1.0))
    if not upright or matrix[0, 0] <= 0.0 or matrix[1, 1] <= 0.0:
        raise DatasetError(f"intrinsics of frame {index} are not a camera matrix", reason=_INTRINSICS)
    return matrix


def _pose_reason(frame: dict[str, Any]) -> str:
    return _INVALID if frame.get("camtoworld") is None else "DATASET_POSE_NOT_RIGID"


def _bounds(metadata: dict[str, Any]) -> NDArray[np.float64]:
    scene_box = metadata.get("scene_box") or {}
    if not isinstance(scene_box, dict):
        raise DatasetError("scene_box is not a JSON object", reason=_INVALID)
    bounds = array(scene_box.get("aabb", USUAL_BOUNDS), ((2, 3),), "aabb of scene_box", _INVALID)
    if not (bounds[0] < bounds[1]).all():
        raise DatasetError("aabb of scene_box: the lowest corner is not below the highest", reason=_INVALID)
    return bounds


def _metric_world(metadata: dict[str, Any]) -> NDArray[np.float64] | None:
    given = metadata.get("worldtogt")
    if given is None:  # some files say it with each instance instead
        named = metadata.get("instances")
        entries = list(named.values()) if isinstance(named, dict) else named or []
        given = next((entry["worldtogt"] for entry in entries if entry.get("worldtogt") is not None), None)
    return None if given is None else similarity(given, "worldtogt", _INVALID)


def _colors(folder: Path, frames: list[dict[str, Any]], size: Size) -> NDArray[np.uint8]:
    paths = [resolve(folder, frame.get("rgb_path"), f"rgb_path of frame {i}") for i, frame in enumerate(frames)]
    return np.stack([read_colors(path, size) for path in paths])


def _depths(
    folder: Path, metadata: dict[str, Any], frames: list[dict[str, Any]], size: Size
) -> NDArray[np.float32] | None:
    if metadata.get("has_sensor_depth") is False:
        return None
    paths = _paths(folder, frames, "sensor_depth_path", bool(metadata.get("has_sensor_depth")))
    if paths is None:
        return None
    given = metadata.get("depth_unit_scale_factor")
    unit = None if given is None else float(array(given, ((),), "depth_unit_scale_factor", _INVALID))
    return np.stack([read_depth(p, size, unit) if p else np.zeros(size, dtype=np.float32) for p in paths])


def _masks(
    folder: Path, metadata: dict[str, Any], frames: list[dict[str, Any]], size: Size
) -> NDArray[np.bool_] | None:
    if metadata.get("has_foreground_mask") is False:
        return None
    paths = _paths(folder, frames, "foreground_mask", bool(metadata.get("has_foreground_mask")))
    if paths is None:
        return None
    return np.stack([read_mask(p, size) if p else np.ones(size, dtype=np.bool_) for p in paths])


def _paths(folder: Path, frames: list[dict[str, Any]], key: str, promised: bool) -> list[Path | None] | None:
    """A frame may lack its file; if all do, the dataset has none of the kind, unless it promised them."""
    named = [frame.get(key) for frame in frames]
    if any(name is not None for name in named):
        what = f"{key} of frame"
        return [None if n is None else resolve(folder, n, f"{what} {i}") for i, n in enumerate(named)]
    if promised:
        raise DatasetError(f"the metadata promises files that no frame names: {key}", reason="DATASET_IMAGE_MISSING")
    return None
