"""The package regnf_ros with stubs of everything of ROS that it imports."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest

from tests.ros2.messages import TYPES

PACKAGE = Path(__file__).resolve().parents[2] / "ros2" / "regnf_ros"
MESSAGES = ("geometry_msgs", "sensor_msgs", "vision_msgs", "yolo_msgs")
LOADED = ("regnf_ros", "rclpy", "rcl_interfaces", "tf2_ros", *MESSAGES, "launch", "launch_ros")


class Recorder:
    """Keeps what it is called with."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        self.arguments, self.named = arguments, named
        self.sent: list[Any] = []

    def publish(self, message: Any) -> None:
        self.sent.append(message)

    sendTransform = publish  # noqa: N815 -- the name in tf2_ros


class Log:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def info(self, text: str) -> None:
        self.lines.append(text)

    warning = error = info


class Node:
    """What the node uses of rclpy's. ``given``: parameters, as a launch file gives them."""

    given: ClassVar[dict[str, Any]] = {}
    remapped: ClassVar[dict[str, str]] = {}

    def __init__(self, name: str) -> None:
        self.name, self.log = name, Log()
        self.subscribed: dict[str, tuple[type, Any]] = {}

    def declare_parameter(self, name: str, default: Any, descriptor: Any = None) -> SimpleNamespace:
        """Of the default's type alone, unless the descriptor says that any type will do."""
        value = self.given.get(name, default)
        if type(value) is not type(default) and not getattr(descriptor, "dynamic_typing", False):
            raise TypeError(f"InvalidParameterTypeException: {name} is {value!r}")
        return SimpleNamespace(value=value)

    def create_publisher(self, kind: type, topic: str, depth: int) -> Recorder:
        return Recorder(kind, topic, depth)

    def create_subscription(self, kind: type, topic: str, callback: Any, quality: Any) -> None:
        self.subscribed[topic] = (kind, callback)

    def resolve_topic_name(self, topic: str) -> str:
        return self.remapped.get(topic, f"/{topic}")

    def get_logger(self) -> Log:
        return self.log


class TransformException(Exception):  # noqa: N818 -- the name in tf2_ros
    """tf2's error for a transform that is not known."""


class Buffer:
    """Knows one transform, if one is set, or the camera's pose over time, by its stamps (s)."""

    known: Any = None
    poses: ClassVar[dict[float, Any]] = {}

    def lookup_transform(self, target: str, source: str, time: Any, timeout: Any) -> Any:
        stamp = time.sec + 1e-9 * time.nanosec
        found = self.poses.get(round(stamp, 6), self.known)
        if found is None:
            raise TransformException(f"no transform from {source} to {target} at {stamp}")
        return found

    def can_transform(self, target: str, source: str, time: Any) -> bool:
        return bool(self.poses) or self.known is not None


def module(name: str, **members: Any) -> None:
    made = ModuleType(name)
    made.__dict__.update(members)
    sys.modules[name] = made


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(PACKAGE))
    before = set(sys.modules)
    assert not before & set(LOADED), "ROS itself is not to be replaced"
    time = type("Time", (), {"from_msg": staticmethod(lambda stamp: stamp)})
    received = {"sensor_msgs": ("Image", "CameraInfo"), "vision_msgs": ("Detection2DArray",),
                "yolo_msgs": ("DetectionArray",)}  # fmt: skip
    module("rclpy", init=None, spin=None, try_shutdown=None)
    module("rclpy.node", Node=Node)
    module("rclpy.logging", get_logger=lambda name: Node(name).log)
    module("rcl_interfaces")
    module("rcl_interfaces.msg", ParameterDescriptor=SimpleNamespace)
    module("rclpy.time", Time=time)
    module("rclpy.duration", Duration=Recorder)
    module("rclpy.qos", qos_profile_sensor_data="sensor data")
    tf = {"Buffer": Buffer, "TransformListener": Recorder, "TransformBroadcaster": Recorder}
    module("tf2_ros", **tf, TransformException=TransformException)
    for package in MESSAGES:
        module(package)
        own = {name.partition("/")[2]: kind for name, kind in TYPES.items() if name.startswith(f"{package}/")}
        own |= {name: type(name, (), {}) for name in received.get(package, ())}
        module(f"{package}.msg", **own)
    module("launch", LaunchDescription=list)
    module("launch.actions", DeclareLaunchArgument=Recorder)
    module("launch.substitutions", LaunchConfiguration=Recorder)
    module("launch_ros")
    module("launch_ros.actions", Node=Recorder)
    module("launch_ros.parameter_descriptions", ParameterValue=Recorder)
    yield
    for name in set(sys.modules) - before:
        if name.partition(".")[0] in LOADED:
            del sys.modules[name]
