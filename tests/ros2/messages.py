"""Stubs of ROS 2's message types with exactly the published fields: any other name raises AttributeError.

Sources: github.com/ros-perception/vision_msgs, branch ros2 (commit e77fa2d), `vision_msgs/msg/*.msg`;
github.com/ros2/common_interfaces (commit c0c0bc5), `geometry_msgs/msg/*.msg` and `std_msgs/msg/Header.msg`;
github.com/ros2/rcl_interfaces, `builtin_interfaces/msg/Time.msg`.
"""

from __future__ import annotations

from typing import Any

PUBLISHED: dict[str, dict[str, str]] = {
    "builtin_interfaces/Time": {"sec": "int32", "nanosec": "uint32"},
    "std_msgs/Header": {"stamp": "builtin_interfaces/Time", "frame_id": "string"},
    "geometry_msgs/Point": {"x": "float64", "y": "float64", "z": "float64"},
    "geometry_msgs/Vector3": {"x": "float64", "y": "float64", "z": "float64"},
    "geometry_msgs/Quaternion": {"x": "float64", "y": "float64", "z": "float64", "w": "float64 1"},
    "geometry_msgs/Pose": {"position": "geometry_msgs/Point", "orientation": "geometry_msgs/Quaternion"},
    "geometry_msgs/PoseWithCovariance": {"pose": "geometry_msgs/Pose", "covariance": "float64[36]"},
    "geometry_msgs/PoseWithCovarianceStamped": {
        "header": "std_msgs/Header",
        "pose": "geometry_msgs/PoseWithCovariance",
    },
    "geometry_msgs/Transform": {"translation": "geometry_msgs/Vector3", "rotation": "geometry_msgs/Quaternion"},
    "geometry_msgs/TransformStamped": {
        "header": "std_msgs/Header",
        "child_frame_id": "string",
        "transform": "geometry_msgs/Transform",
    },
    "vision_msgs/ObjectHypothesis": {"class_id": "string", "score": "float64"},
    "vision_msgs/ObjectHypothesisWithPose": {
        "hypothesis": "vision_msgs/ObjectHypothesis",
        "pose": "geometry_msgs/PoseWithCovariance",
    },
    "vision_msgs/BoundingBox3D": {"center": "geometry_msgs/Pose", "size": "geometry_msgs/Vector3"},
    "vision_msgs/Detection3D": {
        "header": "std_msgs/Header",
        "results": "vision_msgs/ObjectHypothesisWithPose[]",
        "bbox": "vision_msgs/BoundingBox3D",
        "id": "string",
    },
    "vision_msgs/Detection3DArray": {"header": "std_msgs/Header", "detections": "vision_msgs/Detection3D[]"},
}
_KINDS: dict[str, type] = {"int32": int, "uint32": int, "float64": float, "string": str}


class Message:
    """A message whose fields and their types are those of the definition, as rclpy's generated classes have it."""

    definition: dict[str, str]

    def __init__(self) -> None:
        for name, kind in self.definition.items():
            object.__setattr__(self, name, _default(kind))

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self.definition:
            raise AttributeError(f"{type(self).__name__} has no field {name!r}")
        kind = self.definition[name].split()[0]
        if kind.endswith("[36]"):
            assert len(value) == 36
            assert all(type(one) is float for one in value)
        elif kind in _KINDS:
            assert type(value) is _KINDS[kind], (type(self).__name__, name, value)
        else:
            received = getattr(value, "__msgtype__", "").replace("/msg/", "/") == kind
            assert received or isinstance(value, list if kind.endswith("[]") else TYPES[kind])
        object.__setattr__(self, name, value)


def _default(kind: str) -> Any:
    name, _, given = kind.partition(" ")
    if name.endswith("[36]"):
        return [0.0] * 36
    if name.endswith("[]"):
        return []
    if name == "string":
        return ""
    return _KINDS[name](given or 0) if name in _KINDS else TYPES[name]()


TYPES: dict[str, type[Message]] = {
    name: type(name.partition("/")[2], (Message,), {"definition": fields}) for name, fields in PUBLISHED.items()
}
