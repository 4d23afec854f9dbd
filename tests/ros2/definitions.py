"""Messages as ROS sends them: serialized by rosbags' type store and read back. What the store lacks is given as text.

Sources: github.com/ros-perception/vision_msgs, branch ros2, and before its Point2D (until Galactic), `msg/*.msg`;
github.com/mgonzs13/yolo_ros, `yolo_msgs/msg/*.msg`. Comments are left out.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

VISION = {
    "Point2D": "float64 x\nfloat64 y",
    "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "Detection2D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox2D bbox\nstring id",
    "Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
}
OLDER = VISION | {"BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y"}
YOLO = {
    "Point2D": "float64 x\nfloat64 y",
    "Vector2": "float64 x\nfloat64 y",
    "Pose2D": "yolo_msgs/Point2D position\nfloat64 theta",
    "BoundingBox2D": "yolo_msgs/Pose2D center\nyolo_msgs/Vector2 size",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\nstring frame_id",
    "Mask": "int32 height\nint32 width\nyolo_msgs/Point2D[] data",
    "KeyPoint2D": "int32 id\nyolo_msgs/Point2D point\nfloat64 score",
    "KeyPoint2DArray": "yolo_msgs/KeyPoint2D[] data",
    "KeyPoint3D": "int32 id\ngeometry_msgs/Point point\nfloat64 score",
    "KeyPoint3DArray": "yolo_msgs/KeyPoint3D[] data\nstring frame_id",
    "Detection": "int32 class_id\nstring class_name\nfloat64 score\nstring id\nyolo_msgs/BoundingBox2D bbox\n"
    "yolo_msgs/BoundingBox3D bbox3d\nyolo_msgs/Mask mask\nyolo_msgs/KeyPoint2DArray keypoints\n"
    "yolo_msgs/KeyPoint3DArray keypoints3d",
    "DetectionArray": "std_msgs/Header header\nyolo_msgs/Detection[] detections",
}
RELEASES = {
    "jazzy": (Stores.ROS2_JAZZY, VISION),
    "humble": (Stores.ROS2_HUMBLE, VISION),
    "older": (Stores.ROS2_FOXY, OLDER),
}


@cache
def store(release: str = "jazzy") -> Typestore:
    """The types of a distribution, with those of vision_msgs and yolo_msgs."""
    known, vision = RELEASES[release]
    made = get_typestore(known)
    for package, texts in (("vision_msgs", vision), ("yolo_msgs", YOLO)):
        types: dict[str, Any] = {}
        for name, text in texts.items():
            types |= get_types_from_msg(text, f"{package}/msg/{name}")
        made.register(types)
    return made


def received(kind: str, values: dict[str, Any], release: str = "jazzy") -> Any:
    """A message, as of sensor_msgs/Image, after its way through CDR. values: by name; all others are 0 or empty."""
    types, name = store(release), kind.replace("/", "/msg/")
    return types.deserialize_cdr(types.serialize_cdr(_made(types, name, values), name), name)


def _made(types: Typestore, name: str, values: dict[str, Any]) -> Any:
    _, fields = types.fielddefs[name]
    unknown = set(values) - {field for field, _ in fields}
    assert not unknown, f"{name} has no {unknown}"
    return types.types[name](**{field: _value(types, kind, values.get(field)) for field, kind in fields})


def _value(types: Typestore, kind: Any, given: Any) -> Any:
    node, what = kind
    if node == Nodetype.NAME:
        return _made(types, what, given or {})
    if node == Nodetype.BASE:
        if given is not None:
            return given
        return "" if what[0] == "string" else False if what[0] == "bool" else 0.0 if "float" in what[0] else 0
    of, count = what
    if of[0] == Nodetype.BASE and of[1][0] != "string":
        return np.asarray(np.zeros(count or 0) if given is None else given, np.dtype(_numpy(of[1][0])))
    return [_value(types, of, each) for each in given or [None] * (count or 0)]


def _numpy(name: str) -> str:
    return {"byte": "uint8", "octet": "uint8", "char": "uint8"}.get(name, name)


def header(stamp: float, frame: str = "camera") -> dict[str, Any]:
    seconds = int(stamp)
    return {"stamp": {"sec": seconds, "nanosec": round((stamp - seconds) * 1e9)}, "frame_id": frame}


def image(
    stamp: float, pixels: np.ndarray[Any, Any], encoding: str, big: bool = False, padding: int = 0, **more: Any
) -> Any:
    """A sensor_msgs/Image whose rows have ``padding`` bytes after them, which say nothing."""
    height, width = pixels.shape[:2]
    dtype = pixels.dtype.newbyteorder(">" if big else "<")
    rows = np.ascontiguousarray(pixels, dtype).view(np.uint8).reshape(height, -1)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xA5)
    size = {"height": height, "width": width, "step": data.shape[1], "is_bigendian": int(big)}
    values = size | {"header": header(stamp, more.pop("frame", "camera")), "encoding": encoding, "data": data.ravel()}
    return received("sensor_msgs/Image", values, **more)


def camera_info(width: int, height: int, k: tuple[float, ...], **more: Any) -> Any:
    """k: fx, fy, cx, cy."""
    fx, fy, cx, cy = k
    matrix = {
        "k": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "p": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
    return received("sensor_msgs/CameraInfo", {"width": width, "height": height, **matrix, **more})


def boxes(stamp: float, *things: tuple[str, tuple[float, float, float, float]], **more: Any) -> Any:
    """A vision_msgs/Detection2DArray: of each thing its class, and center and size of its box."""
    older = more.get("release") == "older"
    listed = []
    for name, (u, v, width, height) in things:
        place = {"x": u, "y": v}
        box = {"center": place if older else {"position": place}, "size_x": width, "size_y": height}
        guesses = [
            {"hypothesis": {"class_id": "no thing", "score": 0.1}},
            {"hypothesis": {"class_id": name, "score": 0.9}},
        ]
        listed.append({"bbox": box, "results": guesses if name else []})
    return received("vision_msgs/Detection2DArray", {"header": header(stamp), "detections": listed}, **more)


def masks(stamp: float, size: tuple[int, int], *things: tuple[str, list[tuple[float, float]]]) -> Any:
    """A yolo_msgs/DetectionArray: of each thing its class and its mask's corners. size: height and width."""
    listed = []
    for name, corners in things:
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)
        center, extent = (low + high) / 2, high - low
        box = {
            "center": {"position": {"x": float(center[0]), "y": float(center[1])}},
            "size": {"x": float(extent[0]), "y": float(extent[1])},
        }
        mask = {"height": size[0], "width": size[1], "data": [{"x": float(u), "y": float(v)} for u, v in corners]}
        listed.append({"class_name": name, "score": 0.8, "bbox": box, "mask": mask})
    return received("yolo_msgs/DetectionArray", {"header": header(stamp), "detections": listed})
