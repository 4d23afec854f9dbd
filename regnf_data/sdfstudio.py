"""Posed images as sdfstudio keeps them: a folder with ``meta_data.json``, images and depths."""

from __future__ import annotations

import json
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from regnf_core.errors import DatasetError, InvalidDetectionError
from regnf_data.exr import read_exr
from regnf_data.posed_images import Instance, PosedImages

if TYPE_CHECKING:
    from regnf_core.geometry.box import OrientedBox

# Numbers and matrices out of a dataset's JSON, checked.

_RIGID_TOLERANCE = 1e-3  # of rotations and scales: files are often written with few digits
_LARGEST = 1e9  # larger numbers are neither places nor pixels, and their products overflow


def array(value: Any, shapes: tuple[tuple[int, ...], ...], what: str, reason: str) -> NDArray[np.float64]:
    """``value`` as float64 numbers of one of the shapes, finite and up to 1e9. Raises DatasetError (``reason``)."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if numbers.shape not in shapes or not (np.abs(numbers) <= _LARGEST).all():  # NaN is not either
        wanted = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
        raise DatasetError(f"{what} is not {wanted} finite numbers, none beyond {_LARGEST:g}", reason=reason)
    return numbers


def matrix4(value: Any, what: str, reason: str) -> NDArray[np.float64]:
    """An affine (4, 4) matrix; the last row may be left out."""
    given = array(value, ((4, 4), (3, 4)), what, reason)
    matrix = np.eye(4)
    matrix[: len(given)] = given
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-9):
        raise DatasetError(f"{what} is not an affine transform: its last row is not 0 0 0 1", reason=reason)
    return matrix


def rigid(value: Any, what: str, reason: str) -> NDArray[np.float64]:
    """A rotation and a translation, (4, 4)."""
    matrix = matrix4(value, what, reason)
    rotation = matrix[:3, :3]
    straight = np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID_TOLERANCE)
    if not straight or np.linalg.det(rotation) < 0.0:
        raise DatasetError(f"{what} is not a rotation and a translation", reason=reason)
    return matrix


def similarity(value: Any, what: str, reason: str) -> NDArray[np.float64]:
    """A rotation, one positive scale and a translation, (4, 4)."""
    matrix = matrix4(value, what, reason)
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if determinant <= 0.0:
        raise DatasetError(f"{what} is not a similarity: its determinant is not positive", reason=reason)
    rotation = matrix[:3, :3] / np.cbrt(determinant)
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID_TOLERANCE):
        raise DatasetError(f"{what} is not a similarity: it shears or scales unevenly", reason=reason)
    return matrix


def whole_number(value: Any, what: str, reason: str) -> int:
    whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if isinstance(value, bool) or not whole or value < 1:
        raise DatasetError(f"{what} is not a positive whole number", reason=reason)
    return int(value)


# The image files of a dataset: colors, depths and masks, each checked against the size that is due.

Size = tuple[int, int]
"""Height and width, pixels."""

_FAULTS_OF_CONTENT = (
    OSError, SyntaxError, ValueError, EOFError, struct.error, tokenize.TokenError, zlib.error,
    Image.DecompressionBombError, Image.DecompressionBombWarning,
)  # fmt: skip
"""What pillow and numpy raise on malformed files."""


def resolve(folder: Path, name: Any, what: str) -> Path:
    """The file ``name`` in the folder, which it may not leave.

    Raises DatasetError (DATASET_METADATA_INVALID, DATASET_PATH_OUTSIDE, DATASET_IMAGE_MISSING).
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise DatasetError(f"{what} is not a path", reason="DATASET_METADATA_INVALID")
    try:
        path = (folder / name.replace("\\", "/")).resolve()  # as Windows writes paths
        inside = path.is_relative_to(folder.resolve())
        exists = inside and path.is_file()
    except (OSError, RuntimeError, ValueError) as error:  # too long, links in a circle, half a character
        raise DatasetError(f"{what} cannot be resolved: {name!r:.200}", reason="DATASET_METADATA_INVALID") from error
    if not inside:
        raise DatasetError(f"{what} leaves the dataset's folder: {name!r:.200}", reason="DATASET_PATH_OUTSIDE")
    if not exists:
        raise DatasetError(f"{what} is not a file of the dataset: {name!r:.200}", reason="DATASET_IMAGE_MISSING")
    return path


@contextmanager
def opened_image(path: Path) -> Iterator[Image.Image]:
    """The picture in a file. Raises DatasetError (DATASET_IMAGE_INVALID) for what is none, also within the block."""
    try:
        with Image.open(path) as image:
            yield image
    except _FAULTS_OF_CONTENT as error:
        raise _invalid(path, error) from error


def read_depth(path: Path, size: Size, unit: float | None) -> NDArray[np.float32]:
    """(H, W) float32 in world units, 0 where there is none: what is not finite and positive counts as none, and so does
    the largest number that a file's type has (65535 in many recordings).

    ``.npy`` holds world units; an image holds whole numbers of ``unit`` world units each.
    Raises DatasetError (DATASET_DEPTH_UNIT_MISSING, DATASET_SIZES_DIFFER, DATASET_IMAGE_INVALID).
    """
    if path.suffix.lower() in ARRAYS:
        stored, factor = array_file(path), 1.0
        if stored.shape not in (size, (*size, 1), (1, *size)):
            raise _differs(path, stored.shape, size)
        stored = np.array(stored).reshape(size)
    elif unit is None:
        message = f"{path.name}: a depth image needs depth_unit_scale_factor in the metadata"
        raise DatasetError(message, reason="DATASET_DEPTH_UNIT_MISSING")
    else:
        stored, factor = decoded(path, size, None), unit
    largest = np.finfo(stored.dtype).max if stored.dtype.kind == "f" else np.iinfo(stored.dtype).max
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (stored.astype(np.float64) * factor).astype(np.float32)
        measured = np.isfinite(depth) & (depth > 0.0) & (stored < largest)
    return np.where(measured, depth, np.float32(0.0))


ARRAYS = (".npy", ".npz", ".exr")


def array_file(path: Path) -> NDArray[Any]:
    """The numbers of one of ``ARRAYS``; of several arrays the one that is called depth. Of .npy nothing is read yet."""
    try:
        if path.suffix.lower() == ".exr":
            return read_exr(path)
        stored = np.load(path, mmap_mode="r", allow_pickle=False)
        if path.suffix.lower() == ".npz":
            with stored:
                named = [name for name in stored.files if name.startswith("depth")] or stored.files
                if len(named) != 1:
                    raise ValueError(f"it is not clear which array is the depth: {', '.join(stored.files)[:80]}")
                stored = stored[named[0]]
        kind = stored.dtype.kind
    except (*_FAULTS_OF_CONTENT, LookupError, zipfile.BadZipFile) as error:
        raise _invalid(path, error) from error
    if kind not in "fiu":
        raise DatasetError(f"{path.name} holds no numbers", reason="DATASET_IMAGE_INVALID")
    return stored  # type: ignore[no-any-return]


def decoded(path: Path, size: Size, mode: str | None) -> NDArray[Any]:
    """The pixels; with a ``mode``, converted to it. Without: numbers (H, W)."""
    with opened_image(path) as image:
        # Told by the header: nothing of the wrong size is decoded.
        if (image.height, image.width) != size:
            raise _differs(path, (image.height, image.width), size)
        kind, pixels = image.mode, np.asarray(image.convert(mode) if mode else image)
    if pixels.shape[:2] != size or (mode is None and pixels.ndim != 2):
        raise DatasetError(f"{path.name} has more than one channel", reason="DATASET_IMAGE_INVALID")
    if mode is None and (kind == "P" or pixels.dtype.kind not in "fiu"):
        what = "a palette of colors" if kind == "P" else "one bit per pixel, as in masks"
        raise DatasetError(f"{path.name} holds no depths: it has {what}", reason="DATASET_IMAGE_INVALID")
    return pixels


def _differs(path: Path, found: tuple[int, ...], size: Size) -> DatasetError:
    shape = " x ".join(map(str, found))
    return DatasetError(
        f"{path.name} is {shape}, not {size[0]} x {size[1]} (height x width)", reason="DATASET_SIZES_DIFFER"
    )


def _invalid(path: Path, error: BaseException) -> DatasetError:
    return DatasetError(f"{path.name} cannot be read as an image: {error}", reason="DATASET_IMAGE_INVALID")


# Reads a folder in the sdfstudio data format.

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
    metadata = read_metadata(root)
    frames = frames_of(metadata)
    size = _size(metadata, root, frames)
    # What lies in the metadata comes first: it is refused before any image is decoded.
    intrinsics = np.stack([intrinsics_of_frame(frame, metadata, index) for index, frame in enumerate(frames)])
    poses = []
    for index, given in enumerate(frame.get("camtoworld") for frame in frames):
        reason = _INVALID if given is None else "DATASET_POSE_NOT_RIGID"
        poses.append(rigid(given, f"camtoworld of frame {index}", reason))
    bounds, instances, T_metric_world = _bounds(metadata), read_instances(metadata.get("instances")), None
    if (given := worldtogt(metadata)) is not None:
        T_metric_world = similarity(given, "worldtogt", _INVALID)
    unit = metadata.get("depth_unit_scale_factor")
    unit = None if unit is None else float(array(unit, ((),), "depth_unit_scale_factor", _INVALID))
    pictures = [resolve(root, frame.get("rgb_path"), f"rgb_path of frame {i}") for i, frame in enumerate(frames)]
    depths = masks = None
    if (paths := _paths(root, metadata, frames, "sensor_depth_path", "has_sensor_depth")) is not None:
        depths = np.stack([read_depth(p, size, unit) if p else np.zeros(size, np.float32) for p in paths])
    if (paths := _paths(root, metadata, frames, "foreground_mask", "has_foreground_mask")) is not None:
        masks = np.stack([read_mask(p, size) if p else np.ones(size, np.bool_) for p in paths])
    return PosedImages(
        colors=np.stack([np.asarray(decoded(path, size, "RGB"), dtype=np.uint8) for path in pictures]),
        intrinsics=intrinsics,
        T_world_camera=np.stack(poses) * np.array((1.0, -1.0, -1.0, 1.0) if opengl else 1.0),
        bounds=bounds,
        depths=depths,
        masks=masks,
        instances=instances,
        T_metric_world=T_metric_world,
    )


def read_metadata(folder: Path) -> dict[str, Any]:
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


def frames_of(metadata: dict[str, Any]) -> list[dict[str, Any]]:
    """Those with a pose. Raises DatasetError for cameras that are no pinholes, too."""
    model = metadata.get("camera_model", "OPENCV")
    if model not in _CAMERAS:
        message = f"camera model {model!r:.80}: only {', '.join(_CAMERAS)}"
        raise DatasetError(message, reason="DATASET_CAMERA_UNSUPPORTED")
    if any(metadata.get(name) not in (None, 0, 0.0) for name in _DISTORTION):
        raise DatasetError("the images have lens distortion: undistort them", reason="DATASET_CAMERA_UNSUPPORTED")
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
    if metadata.get("height") is None or metadata.get("width") is None:
        with opened_image(resolve(folder, frames[0].get("rgb_path"), "rgb_path of frame 0")) as image:
            height, width = image.height, image.width
    else:
        height, width = (whole_number(metadata[name], name, _INVALID) for name in ("height", "width"))
    if len(frames) * height * width > _MAX_PIXELS:
        message = f"{len(frames)} images of {height} x {width}: more than {_MAX_PIXELS} pixels"
        raise DatasetError(message, reason="DATASET_TOO_LARGE")
    return height, width


def intrinsics_of_frame(frame: dict[str, Any], metadata: dict[str, Any], index: int) -> NDArray[np.float64]:
    given = frame.get("intrinsics", metadata.get("intrinsics"))
    matrix = array(given, ((4, 4), (3, 3), (3, 4)), f"intrinsics of frame {index}", _INTRINSICS)[:3, :3]
    upright = np.allclose(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], (0.0, 0.0, 0.0, 1.0))
    if not upright or matrix[0, 0] <= 0.0 or matrix[1, 1] <= 0.0:
        raise DatasetError(f"intrinsics of frame {index} are not a camera matrix", reason=_INTRINSICS)
    return matrix


def _bounds(metadata: dict[str, Any]) -> NDArray[np.float64]:
    scene_box = metadata.get("scene_box") or {}
    if not isinstance(scene_box, dict):
        raise DatasetError("scene_box is not a JSON object", reason=_INVALID)
    bounds = array(scene_box.get("aabb", USUAL_BOUNDS), ((2, 3),), "aabb of scene_box", _INVALID)
    if not (bounds[0] < bounds[1]).all():
        raise DatasetError("aabb of scene_box: the lowest corner is not below the highest", reason=_INVALID)
    return bounds


def worldtogt(metadata: dict[str, Any]) -> Any:
    """Some files say it with each instance instead."""
    named = metadata.get("instances") or []
    entries = list(named.values()) if isinstance(named, dict) else named
    return next((e["worldtogt"] for e in (metadata, *entries) if e.get("worldtogt") is not None), None)


def read_mask(path: Path, size: Size) -> NDArray[np.bool_]:
    """(H, W): true where the picture is brighter than half; one of zeros and ones counts as such."""
    gray = decoded(path, size, "L")
    return np.asarray(gray > (127 if gray.max() > 1 else 0))


def _paths(
    folder: Path, metadata: dict[str, Any], frames: list[dict[str, Any]], key: str, promise: str
) -> list[Path | None] | None:
    """A frame may lack its file; if all do, the dataset has none of the kind, unless it promised them."""
    named = [frame.get(key) for frame in frames]
    if metadata.get(promise) is False:
        return None
    if any(name is not None for name in named):
        what = f"{key} of frame"
        return [None if n is None else resolve(folder, n, f"{what} {i}") for i, n in enumerate(named)]
    if metadata.get(promise):
        raise DatasetError(f"the metadata mentions files that no frame has: {key}", reason="DATASET_IMAGE_MISSING")
    return None


# The objects that a dataset names: their boxes and poses, in JSON and out of it.

_REASON = "DATASET_INSTANCE_INVALID"
_LABELS = ("label", "name", "id", "class", "class_name")
_LONGEST_LABEL = 200
_CORNER_TOLERANCE = 1e-3
"""Of a box's corners, as a share of its diagonal."""


def read_instances(given: Any) -> tuple[Instance, ...]:
    """The instances of a list, or of an object that names them by its keys; None is none.

    Raises DatasetError (DATASET_INSTANCE_INVALID).
    """
    if not isinstance(given, dict | list | None):
        raise DatasetError("instances are neither a list nor an object", reason=_REASON)
    named = given.items() if isinstance(given, dict) else ((None, entry) for entry in given or ())
    return tuple(_read(entry, name) for name, entry in named)


def _box_of_corners(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Center (3,), edge lengths (3,) and axes (3, 3), as columns, of the box whose corners (8, 3) come in any order."""
    offsets = corners[1:] - corners[0]
    lengths = np.linalg.norm(offsets, axis=1)
    diagonal = offsets[lengths.argmax()]
    allowed = _CORNER_TOLERANCE * float(np.linalg.norm(diagonal))
    for chosen in combinations(range(7), 3):
        edges, size = offsets[list(chosen)], lengths[list(chosen)]
        if size.min() <= 0.0 or np.abs(edges.sum(axis=0) - diagonal).max() > allowed:
            continue
        axes = (edges / size[:, None]).T
        if np.abs(axes.T @ axes - np.eye(3)).max() <= _CORNER_TOLERANCE:
            if np.linalg.det(axes) < 0.0:
                axes = axes[:, ::-1]
                size = size[::-1]
            left, _, right = np.linalg.svd(axes)
            return corners.mean(axis=0), size, left @ right
    raise DatasetError("box_corners are not the eight corners of a box", reason=_REASON)


def _read(entry: Any, name: str | None) -> Instance:
    if not isinstance(entry, dict):
        raise DatasetError("an instance is not a JSON object", reason=_REASON)
    label = str(next((entry[key] for key in _LABELS if entry.get(key) is not None), name or "instance"))
    label = "".join(letter if letter.isprintable() else "?" for letter in label[:_LONGEST_LABEL])
    read = {"T_object_world": similarity, "world_pose": matrix4, "gt_pose": matrix4}
    known = {k: of(entry[k], f"{k} of {label}", _REASON) for k, of in read.items() if entry.get(k) is not None}
    return Instance(label, _box(entry, label), **known)


def _box(entry: dict[str, Any], label: str) -> OrientedBox:
    """What says most about the box comes first: box, box_corners, box_min with box_max."""
    import torch  # recordings are read without

    from regnf_core.geometry.box import OrientedBox

    try:
        if isinstance(entry.get("box"), dict):
            shapes = {"center": (3,), "size": (3,), "rotation": (3, 3)}
            parts = [array(entry["box"].get(k), (s,), f"box {k} of {label}", _REASON) for k, s in shapes.items()]
        elif entry.get("box_corners") is not None:
            corners = array(entry["box_corners"], ((8, 3),), f"box_corners of {label}", _REASON)
            parts = list(_box_of_corners(corners))
            if np.allclose(np.abs(parts[2]).max(axis=0), 1.0, atol=1e-6):
                return OrientedBox.from_corners(corners.min(axis=0), corners.max(axis=0), label)
        else:
            lower, upper = (array(entry.get(k), ((3,),), f"{k} of {label}", _REASON) for k in ("box_min", "box_max"))
            return OrientedBox.from_corners(lower, upper, label)
        center, size, rotation = (torch.tensor(np.ascontiguousarray(part)) for part in parts)
        return OrientedBox(center, size, rotation, label)
    except InvalidDetectionError as error:
        raise DatasetError(f"the box of {label}: {error}", reason=_REASON) from error
