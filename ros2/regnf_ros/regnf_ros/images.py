"""Images, cameras and 2D detections of ROS messages, as the service takes them. numpy and zlib alone, no ROS.

Messages are read by their fields' names, whatever class they are of. Pixels are those of ROS: the center of the first
one lies at (0, 0) for a camera's intrinsics.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Size = tuple[int, int]
"""Height and width, pixels."""
DEPTH = {"16UC1": ("u2", 1), "mono16": ("u2", 1), "32FC1": ("f4", 1)}
COLOR = {"rgb8": ("u1", 3), "bgr8": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4), "mono8": ("u1", 1)}
MILLIMETER, FINE = 0.001, 0.0001
"""Meters of a step of the depth that is sent: millimeters are sent as they are, meters in finer steps if they fit."""
_FARTHEST = 65535
_RATIO = 0.02
"""By how much the sides' ratios of two images of one camera may differ."""


@dataclass(frozen=True, eq=False)
class CameraImage:
    """What one camera saw at one time, as parts of a request. depth, color: PNG.

    size: of the image that detections are sent in pixels of: the color's, or the depth's where no color is sent ·
    camera: the part of that name, T_world_camera included · T_map_camera: None where the camera's frame is the world.
    """

    depth: bytes
    camera: dict[str, Any]
    size: Size
    color: bytes | None = None
    T_map_camera: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Seen:
    """One 2D detection. box: left, top, right, bottom · outline: the corners of its mask, [x, y, x, y, ...] · size: of
    the image that both are in pixels of, where the message says it."""

    class_id: str
    score: float
    box: tuple[float, float, float, float]
    outline: tuple[float, ...] = ()
    size: Size | None = None

    def detection(self, size: Size, own: Size) -> dict[str, Any]:
        """As the service takes it, in pixels of an image of ``size``. own: of the image that it was made in, where the
        message does not say it. Raises ValueError where one is no smaller copy of the other.
        """
        down, across = _scales(size, self.size or own)
        said: dict[str, Any] = {"frame": 0, "label": self.class_id}
        if 0.0 <= self.score <= 1.0:
            said["score"] = self.score
        if self.outline:
            scales = (across, down) * (len(self.outline) // 2)
            return said | {"mask": [[scale * one for scale, one in zip(scales, self.outline, strict=True)]]}
        left, top, right, bottom = self.box
        if not (left < right and top < bottom and all(map(math.isfinite, self.box))):
            raise ValueError(f"the box {self.box} of the detection has no area")
        return said | {"box_2d": [across * left, down * top, across * right, down * bottom]}


def camera_image(
    depth: Any, info: Any, color: Any | None, T_map_camera: NDArray[np.float64] | None, rectified: bool
) -> CameraImage:
    """Of messages of one time. rectified: whether the depth image is. Raises ValueError."""
    values, unit = depth_of(depth)
    camera = camera_of(info, rectified, values.shape)
    T_world_camera = np.eye(4) if T_map_camera is None else T_map_camera
    camera |= {"depth_unit": unit, "T_world_camera": T_world_camera.tolist()}
    size, picture = values.shape, None
    if color is not None:
        taken = color_of(color)
        size, picture = taken.shape[:2], png(taken)
        _scales(values.shape, size)
    return CameraImage(png(values), camera, size, picture, T_map_camera)


def _scales(size: Size, given: Size) -> tuple[float, float]:
    """Of rows and columns, from an image of the size ``given`` to one of ``size``. Raises ValueError."""
    down, across = size[0] / given[0], size[1] / given[1]
    if abs(math.log(down / across)) > _RATIO:
        raise ValueError(
            f"the color image has {given[1]} x {given[0]} pixels, the depth image {size[1]} x {size[0]}: subscribe to"
            " depth that is aligned to the color image"
        )
    return down, across


def depth_of(message: Any) -> tuple[NDArray[np.uint16], float]:
    """(H, W): steps of so many meters, 0 where nothing was measured. Raises ValueError."""
    stored = pixels(message, DEPTH)
    if stored.dtype.kind == "u":
        return stored, MILLIMETER
    with np.errstate(invalid="ignore"):
        meters = np.where(np.isfinite(stored) & (stored > 0.0), stored.astype(np.float64), 0.0)
    unit = FINE if meters.max() < _FARTHEST * FINE else MILLIMETER
    steps = np.rint(meters / unit)
    return np.where(steps < _FARTHEST, steps, 0.0).astype(np.uint16), unit


def color_of(message: Any) -> NDArray[np.uint8]:
    """(H, W, 3), red first, or (H, W) of a gray image. Raises ValueError."""
    stored = pixels(message, COLOR)
    if stored.ndim == 2:
        return stored
    return stored[..., [2, 1, 0]] if message.encoding.startswith("bgr") else stored[..., :3]


def pixels(message: Any, codings: dict[str, tuple[str, int]]) -> NDArray[Any]:
    """(H, W) or (H, W, C) of a sensor_msgs/Image, in this machine's order of bytes. Raises ValueError."""
    if message.encoding not in codings:
        raise ValueError(f"an image has the encoding {message.encoding!r}, expected one of {', '.join(codings)}")
    kind, channels = codings[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    data, row = np.frombuffer(message.data, np.uint8), width * channels * dtype.itemsize
    if height * width == 0 or step < row or data.size < (height - 1) * step + row:
        raise ValueError(f"an image of {width} x {height} pixels has {data.size} bytes in rows of {step}")
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1))
    stored = np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels).astype(dtype.newbyteorder("="))
    return stored[..., 0] if channels == 1 else stored


def png(image: NDArray[Any]) -> bytes:
    """(H, W) of 8 or 16 bits, or (H, W, 3) of 8."""
    height, width = image.shape[:2]
    rows = np.ascontiguousarray(image, image.dtype.newbyteorder(">")).view(np.uint8).reshape(height, -1)
    lines = np.pad(rows, ((0, 0), (1, 0))).tobytes()  # before each row the number of its filter: none
    head = struct.pack(">IIBBBBB", width, height, 8 * image.dtype.itemsize, 2 if image.ndim == 3 else 0, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(lines, 1)), (b"IEND", b""))
    parts = (
        struct.pack(">I", len(one)) + name + one + struct.pack(">I", zlib.crc32(name + one)) for name, one in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def camera_of(info: Any, rectified: bool, size: Size) -> dict[str, Any]:
    """Of a sensor_msgs/CameraInfo. size: of the image, where the message does not say it.

    K and the lens are those of the raw image; a rectified one has the focal lengths of P and no lens. Both are of the
    whole sensor: what is sent of it begins at the region's corner, and has fewer pixels where they are binned.
    Raises ValueError for a camera without intrinsics.
    """
    k, d = np.asarray(info.k, dtype=np.float64), np.asarray(info.d, dtype=np.float64)
    p = np.asarray(info.p, dtype=np.float64)
    if rectified and d.any() and p[0] > 0.0:
        k, d = p.reshape(3, 4)[:, :3].ravel(), np.zeros(0)
    if not (np.isfinite(k).all() and np.isfinite(d).all() and min(k[0], k[4]) > 0.0):
        raise ValueError("camera_info has no intrinsics: the camera is not calibrated")
    across, down = max(1, int(info.binning_x)), max(1, int(info.binning_y))
    region = info.roi
    left, top = int(region.x_offset), int(region.y_offset)
    width, height = int(region.width or info.width) // across, int(region.height or info.height) // down
    return {
        "fx": k[0] / across,
        "fy": k[4] / down,
        "cx": (k[2] + 0.5 - left) / across - 0.5,
        "cy": (k[5] + 0.5 - top) / down - 0.5,
        "width": width or size[1],
        "height": height or size[0],
        "distortion_model": info.distortion_model if d.any() else "",
        "D": d.tolist() if d.any() else [],
    }


def seen_in(message: Any) -> list[Seen]:
    """Of a vision_msgs/Detection2DArray, in the layout of any distribution, or a yolo_msgs/DetectionArray.

    What has no class is left out: its class is "".
    """
    return [_yolo(one) if hasattr(one, "class_name") else _vision(one) for one in message.detections]


def _vision(one: Any) -> Seen:
    best = max((each.hypothesis for each in one.results), key=lambda each: each.score, default=None)
    center = one.bbox.center
    place = getattr(center, "position", center)  # until Galactic the center was a geometry_msgs/Pose2D
    box = _around(place, center.theta, one.bbox.size_x, one.bbox.size_y)
    return Seen("", 0.0, box) if best is None else Seen(best.class_id, float(best.score), box)


def _yolo(one: Any) -> Seen:
    center, mask = one.bbox.center, one.mask
    box = _around(center.position, center.theta, one.bbox.size.x, one.bbox.size.y)
    size = (int(mask.height), int(mask.width)) if mask.height > 0 and mask.width > 0 else None
    outline = tuple(value for corner in mask.data for value in (float(corner.x), float(corner.y)))
    usable = len(outline) >= 6 and all(map(math.isfinite, outline))
    return Seen(one.class_name, float(one.score), box, outline if usable else (), size)


def _around(center: Any, theta: float, width: float, height: float) -> tuple[float, float, float, float]:
    """The upright box around one that is turned by ``theta``."""
    cosine, sine = abs(math.cos(theta)), abs(math.sin(theta))
    across, down = (width * cosine + height * sine) / 2.0, (width * sine + height * cosine) / 2.0
    return center.x - across, center.y - down, center.x + across, center.y + down
