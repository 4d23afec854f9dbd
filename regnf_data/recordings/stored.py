"""A recording in one file of plain arrays: what a service keeps, and what is sent to it. No image is decoded from it.

A safetensors file. depth: (N, H, W) int16, steps of ``depth_unit``, (N, 1) float64, meters along the camera's axis, 0
where nothing was measured · K: (N, 3, 3) float64, pixel centers at + 0.5 · T_world_camera: (N, 4, 4) float64, OpenCV's
axes · color: (N, H', W', 3) uint8 and color_K: (N, 3, 3), where the frames have colors. Its metadata: an entry
``recording``, JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from regnf_core.errors import DatasetError, atomic_path
from regnf_data.posed_images import NO_TERMS, Terms
from regnf_data.recordings.camera import HALF_A_PIXEL, Array, Camera, Lens, camera_of, lens_of
from regnf_data.recordings.recording import Frame, Recording, StoredFrame, no_meters, pose_of

_KEY = "recording"
_STEPS = 32_767
_FINEST = 1e-4
"""Meters a step of stored depths, where they reach no farther than 3.2 m; else as many as reach asks for."""


_Sizes = tuple[tuple[int, ...], tuple[int, ...] | None]
"""Of a depth image and of its color image: height and width."""


def write_recording(recording: Recording, indices: Sequence[int], path: Path) -> dict[str, Any]:
    """Write the frames of these numbers to ``path``, one at a time: those with the most common size of a depth image,
    and their colors of the most common size.

    What was written: frames (their names), size and color_size ([height, width]), depth_range (m).
    Raises DatasetError as the frames' readers do, and DATASET_DEPTH_MISSING.
    """
    frames = [recording.frames[index] for index in indices]
    wanted = _sizes(frames[0].read())
    with atomic_path(path) as target:
        while True:  # once, where all frames have the sizes of the first one
            sizes, ends = _write_frames(recording, frames, wanted, target)
            if not ends:
                raise DatasetError(f"{recording.name}: no frame has a measured depth", reason="DATASET_DEPTH_MISSING")
            shape = _most_common([depth for depth, _ in sizes])
            common = shape, _most_common([color for _, color in sizes if color] or [None])
            kept = [frame for frame, (depth, _) in zip(frames, sizes, strict=True) if depth == shape]
            if common == wanted and len(kept) == len(frames):
                break
            frames, wanted = kept, common
    near, far = min(low for low, _ in ends), max(high for _, high in ends)
    names = [frame.name for frame in frames]
    return {"frames": names, "size": wanted[0], "color_size": wanted[1], "depth_range": [near, far]}


def _sizes(frame: Frame) -> _Sizes:
    return frame.depth.shape, None if frame.color is None else frame.color.shape[:2]


def _write_frames(
    recording: Recording, frames: Sequence[StoredFrame], wanted: _Sizes, path: Path
) -> tuple[list[_Sizes], list[tuple[float, float]]]:
    """Write those of the wanted sizes, each at its place, to a safetensors file; the sizes that all have, and the ends
    of their depths. The format: https://github.com/huggingface/safetensors, 8 bytes of the header's length, the header,
    the bytes."""
    count, (shape, color) = len(frames), wanted
    seen, bent = frames[0].color_camera or frames[0].camera, frames[0].taken or frames[0].camera
    said = {
        "names": [frame.name for frame in frames],
        "layout": recording.layout,
        "notes": list(recording.notes),
        "is_metric": recording.is_metric,
        "lens": [bent.lens, list(bent.distortion)],
        "color_lens": [seen.lens, list(seen.distortion)],
        "T_metric_world": None if recording.T_metric_world is None else recording.T_metric_world.tolist(),
        "terms": asdict(recording.terms),
    }
    kinds = {"depth_unit": ("F64", (1,)), "K": ("F64", (3, 3)), "T_world_camera": ("F64", (4, 4))}
    kinds |= {"color_K": ("F64", (3, 3)), "depth": ("I16", shape), "color": ("U8", (*(color or ()), 3))}
    if color is None:
        del kinds["color_K"], kinds["color"]
    header: dict[str, Any] = {"__metadata__": {_KEY: json.dumps(said)}}
    at = 0
    for name, (kind, one) in kinds.items():
        end = at + _ITEM[kind] * count * math.prod(one)
        header[name] = {"dtype": kind, "shape": [count, *one], "data_offsets": [at, end]}
        at = end
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    sizes, ends = [], []
    with path.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        file.seek(7 + len(text) + at)
        file.write(b"\0")  # what is not written below is 0
        for number, stored in enumerate(frames):
            frame = stored.read()
            sizes.append(_sizes(frame))
            if sizes[-1][0] != shape:
                continue
            far = float(frame.depth.max())
            if far > 0.0:
                ends.append((float(frame.depth[frame.depth > 0.0].min()), far))
            unit = max(_FINEST, far / _STEPS)
            parts = {"depth_unit": np.array([unit]), "K": frame.camera.K, "T_world_camera": frame.T_world_camera}
            parts["depth"] = np.round(frame.depth / unit).astype(np.int16)
            if frame.color is not None and frame.color_camera is not None and sizes[-1][1] == color:
                parts |= {"color_K": frame.color_camera.K, "color": frame.color}
            for name, array in parts.items():
                first, last = header[name]["data_offsets"]
                file.seek(8 + len(text) + first + number * (last - first) // count)
                file.write(np.ascontiguousarray(array).tobytes())
    return sizes, ends


_ITEM = {"U8": 1, "I16": 2, "F64": 8}


def is_stored(path: Path) -> bool:
    """Whether a file is a stored recording."""
    if path.suffix != ".safetensors" or not path.is_file():
        return False
    try:
        with safe_open(path, "numpy") as file:
            return _KEY in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def read_stored(path: Path, name: str | None = None) -> Recording:
    """The recording; each frame's arrays are read when the frame is. Everything is checked: files come from others.

    Raises DatasetError (DATASET_FILE_INVALID, and those of its cameras and poses).
    """
    try:
        with safe_open(path, "numpy") as file:
            said = json.loads((file.metadata() or {})[_KEY])
            shapes = {key: tuple(file.get_slice(key).get_shape()) for key in file.keys()}  # noqa: SIM118
            K, poses, units = (file.get_tensor(key) for key in ("K", "T_world_camera", "depth_unit"))
            color_K = file.get_tensor("color_K") if "color_K" in shapes else None
        names = [str(one)[:200] for one in said["names"]]
        count, height, width = shapes["depth"]
        fits = K.shape == (count, 3, 3) and poses.shape == (count, 4, 4) and len(names) == count
        color = shapes.get("color")
        if color is not None and color_K is not None:
            fits = fits and len(color) == 4 and (color[0], color[3]) == (count, 3) and color_K.shape == (count, 3, 3)
        if not (fits and units.shape == (count, 1) and ((units > 0.0) & (units < 1.0)).all()):
            raise ValueError("its arrays do not fit together")
        colors = None if color is None or color_K is None else ((color[1], color[2]), color_K)
        metric = None if said.get("T_metric_world") is None else np.array(said["T_metric_world"], np.float64)
        lens, color_lens = (_lens_of(said.get(one, ["none", []]), path.name) for one in ("lens", "color_lens"))
        layout, notes = str(said["layout"])[:100], tuple(str(one)[:500] for one in said["notes"])
        told = said.get("terms", {})
        terms = Terms(**{key: type(usual)(told.get(key, usual)) for key, usual in asdict(NO_TERMS).items()})
        if terms.axes not in ("opencv", "opengl"):
            raise ValueError("the axes of its cameras are not known")
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        message = f"{path.name} is not a recording of regnf: {error}"
        raise DatasetError(message[:300], reason="DATASET_FILE_INVALID") from error
    frames = []
    for number in range(count):
        pose = pose_of(poses[number], names[number])
        if pose is None:
            raise DatasetError(f"{names[number]}: the pose is not finite", reason="DATASET_POSE_NOT_RIGID")
        colored = colors is not None and colors[1][number].any()
        frames.append(
            StoredFrame(
                names[number],
                Camera(K[number].astype(np.float64), (height, width)),
                pose,
                partial(_depth, path, number, float(units[number, 0])),
                partial(_color, path, number) if colored else None,
                Camera(colors[1][number].astype(np.float64), colors[0], *color_lens) if colored and colors else None,
                taken=None if lens[0] == "none" else Camera(K[number].astype(np.float64), (height, width), *lens),
            )
        )
    return Recording(name or path.name, layout, tuple(frames), notes, metric, bool(said.get("is_metric", True)), terms)


def _lens_of(said: Any, name: str) -> tuple[Lens, tuple[float, ...]]:
    kind, coefficients = said
    if kind not in ("none", "brown", "fisheye", "inverse"):
        raise ValueError(f"a lens {str(kind)[:20]!r}")
    found, numbers = ("none", ()) if kind == "none" else lens_of(coefficients, kind == "fisheye", name)
    return "inverse" if (found, kind) == ("brown", "inverse") else found, numbers


def _depth(path: Path, number: int, unit: float) -> NDArray[np.float32]:
    with safe_open(path, "numpy") as file:
        return np.asarray(file.get_slice("depth")[number].astype(np.float32) * np.float32(unit))


def _color(path: Path, number: int) -> NDArray[np.uint8]:
    with safe_open(path, "numpy") as file:
        return np.asarray(file.get_slice("color")[number], dtype=np.uint8)


def recording_of_frames(frames: Sequence[Frame], name: str = "frames", layout: str = "frames") -> Recording:
    """Frames in memory as a recording."""

    held = []
    for one in frames:
        color: Callable[[], NDArray[np.uint8]] | None = None if one.color is None else partial(_same, one.color)
        depth, pose = partial(_same, one.depth), one.T_world_camera
        held.append(StoredFrame(one.name, one.camera, pose, depth, color, one.color_camera, taken=one.taken))
    return Recording(name, layout, tuple(held))


def _same(array: NDArray[Any]) -> NDArray[Any]:
    return array


def _most_common(values: Sequence[Any]) -> Any:
    return max(set(values), key=values.count)


def frame_of_arrays(
    depth: NDArray[Any],
    K: Any,
    color: NDArray[Any] | None = None,
    depth_unit: float | None = None,
    T_world_camera: Any = None,
    name: str = "0",
) -> Frame:
    """A frame of arrays in memory, as a camera's driver gives them.

    depth: (H, W), meters along the camera's axis, or whole numbers of ``depth_unit`` meters (None: millimeters); 0 and
    NaN are no measurement · K: (3, 3) or fx, fy, cx, cy, pixel centers at whole numbers, as OpenCV has them · color:
    (H', W', 3) uint8, by the same camera · T_world_camera: (4, 4), OpenCV's axes; None: the camera is the world.
    Raises DatasetError (DATASET_INTRINSICS_INVALID, DATASET_IMAGE_INVALID, DATASET_POSE_NOT_RIGID).
    """
    image = np.asarray(depth)
    if image.ndim != 2 or image.dtype.kind not in "fiu":
        raise DatasetError(f"the depth is {image.dtype} {image.shape}, expected (H, W)", reason="DATASET_IMAGE_INVALID")
    whole = image.dtype.kind in "iu"
    meters = image.astype(np.float32) * np.float32((depth_unit or 0.001) if whole else (depth_unit or 1.0))
    limit = np.iinfo(image.dtype).max if whole else np.inf
    if not whole and depth_unit is None and no_meters(meters):
        message = (
            f"{name}: the depths are {np.nanmedian(meters):.4g} in the median, which are not meters: give depth_unit"
        )
        raise DatasetError(message, reason="DATASET_IMAGE_INVALID")
    meters[~((meters > 0.0) & (image < limit))] = 0.0
    matrix: Array = np.array(K, np.float64)
    if matrix.shape == (4,):
        matrix = camera_of(*matrix).K
    if matrix.shape != (3, 3):
        raise DatasetError(
            f"K has the shape {matrix.shape}, expected (3, 3) or fx, fy, cx, cy", reason="DATASET_INTRINSICS_INVALID"
        )
    pose = np.eye(4) if T_world_camera is None else pose_of(T_world_camera, name)
    if pose is None:
        raise DatasetError(f"{name}: the pose is not finite", reason="DATASET_POSE_NOT_RIGID")
    height, width = meters.shape
    camera = Camera(matrix + HALF_A_PIXEL, (height, width)).check(name)
    if color is None:
        return Frame(name, meters, camera, pose)
    picture = np.asarray(color)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        message = f"the color is {picture.dtype} {picture.shape}, expected (H, W, 3) of uint8"
        raise DatasetError(message, reason="DATASET_IMAGE_INVALID")
    return Frame(name, meters, camera, pose, picture, camera.of_size((picture.shape[0], picture.shape[1]), name))
