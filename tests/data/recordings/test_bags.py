"""Bags as recorders of several kinds leave them: read, or refused with their topics named."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.convert.converter import convert
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer
from rosbags.typesys import Stores, get_typestore

from regnf_core.errors import DatasetError
from regnf_data.recordings.opening import open_recording
from regnf_data.recordings.recording import Given, Recording
from tests.data.recordings import writers
from tests.data.recordings.truth import Truth, walk

STORE = get_typestore(Stores.ROS2_HUMBLE)
DEPTH, COLOR, INFO = "/camera/depth/image_rect_raw", "/camera/color/image", "/camera/depth/camera_info"
Change = Callable[[str, Any], Iterable[tuple[str, Any]]]


@cache
def truth() -> Truth:
    return walk(3)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return writers.bag(tmp_path_factory.mktemp("bags") / "plain", truth())


def rewritten(source: Path, target: Path, change: Change, compression: CompressionMode = CompressionMode.NONE) -> Path:
    """The bag with each message changed, left out or written to several topics."""
    writer = Writer(target, version=9)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer, AnyReader([source], default_typestore=STORE) as reader:
        connections: dict[str, Any] = {}
        for connection, time, raw in reader.messages():
            for topic, message in change(connection.topic, reader.deserialize(raw, connection.msgtype)):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
                writer.write(connections[topic], time, STORE.serialize_cdr(message, kind))
    return target


def same(topic: str, message: Any) -> Iterable[tuple[str, Any]]:
    yield topic, message


def named(**names: str | None) -> Change:
    """Topics of other names; None: without it."""
    known = {"depth": DEPTH, "color": COLOR, "info": INFO, "tf": "/tf", "fixed": "/tf_static"}
    to = {known[name]: new for name, new in names.items()}

    def change(topic: str, message: Any) -> Iterable[tuple[str, Any]]:
        if (new := to.get(topic, topic)) is not None:
            yield new, message

    return change


def two_cameras(topic: str, message: Any) -> Iterable[tuple[str, Any]]:
    if topic not in (DEPTH, INFO):
        yield topic, message
        return
    yield topic.replace("/camera/", "/left/"), message
    other = copy.deepcopy(message)
    other.header.frame_id = "right_optical"
    yield topic.replace("/camera/", "/right/"), other


def without_stamps(topic: str, message: Any) -> Iterable[tuple[str, Any]]:
    """A driver that stamps no image."""
    if hasattr(message, "header"):
        message.header.stamp.sec = message.header.stamp.nanosec = 0
    yield topic, message


def with_images_as_png(topic: str, message: Any) -> Iterable[tuple[str, Any]]:
    """As image_transport compresses a depth image that it takes for any image."""
    if topic == DEPTH:
        image = np.frombuffer(message.data.tobytes(), np.uint16).reshape(message.height, message.width)
        data = np.frombuffer(writers.png_bytes(image), np.uint8)
        compressed = STORE.types["sensor_msgs/msg/CompressedImage"]
        message = compressed(message.header, "16UC1; png compressed ", data)
    yield topic, message


def of_realsense(topic: str, message: Any) -> Iterable[tuple[str, Any]]:
    """The topics of RealSense's own recorder, its unit, and no poses."""
    names = {DEPTH: "/device_0/sensor_0/Depth_0/image/data", INFO: "/device_0/sensor_0/Depth_0/info/camera_info"}
    if topic == DEPTH:
        message.encoding = "mono16"
        number = STORE.types["std_msgs/msg/Float32"]
        yield "/device_0/sensor_0/option/Depth_Units/value", number(0.0005)
    if topic in names:
        yield names[topic], message


def assert_read(recording: Recording, factor: float = 1.0) -> None:
    assert len(recording) == len(truth())
    np.testing.assert_allclose(recording.frames[1].read().depth, factor * truth().depths[1], atol=0.00051)


READ: dict[str, tuple[Change, CompressionMode, float]] = {
    "files compressed": (same, CompressionMode.FILE, 1.0),
    "messages compressed": (same, CompressionMode.MESSAGE, 1.0),
    "no stamps": (without_stamps, CompressionMode.NONE, 1.0),
    "PNG": (with_images_as_png, CompressionMode.NONE, 1.0),
    "RealSense": (of_realsense, CompressionMode.NONE, 0.5),
    "no poses": (named(tf=None, fixed=None), CompressionMode.NONE, 1.0),
    "no color": (named(color=None), CompressionMode.NONE, 1.0),
}


@pytest.mark.parametrize("name", READ)
def test_bags_of_recorders_are_read(name: str, plain: Path, tmp_path: Path) -> None:
    change, compression, factor = READ[name]
    recording = open_recording(rewritten(plain, tmp_path / "bag", change, compression))
    assert_read(recording, factor)
    assert ("poses" in " ".join(recording.notes)) or name == "no stamps"


def test_a_bag_of_ros_1_is_read(plain: Path, tmp_path: Path) -> None:
    convert([plain], tmp_path / "one.bag", "sqlite3", 9, None, "", STORE, get_typestore(Stores.ROS1_NOETIC),
            [], [], [], [])  # fmt: skip
    assert_read(open_recording(tmp_path / "one.bag"))


def test_of_several_cameras_one_is_chosen(plain: Path, tmp_path: Path) -> None:
    bag = rewritten(plain, tmp_path / "bag", two_cameras)
    left, right = (f"/{side}/depth/image_rect_raw" for side in ("left", "right"))
    with pytest.raises(DatasetError, match=f"several cameras: {left}, {right}") as refused:
        open_recording(bag)
    assert refused.value.reason == "DATASET_TOPIC_AMBIGUOUS"
    assert refused.value.hint == f"Choose one: --layout rosbag2:{left}"
    recording = open_recording(bag, Given(layout=f"rosbag2:{left}"))
    assert_read(recording)
    assert f"not used: {right}" in recording.notes
    with pytest.raises(DatasetError, match=f"no depth images on /up. It has {left}, {right}"):
        open_recording(bag, Given(layout="rosbag2:/up"))


@pytest.mark.parametrize(
    ("change", "reason", "said"),
    [
        (named(depth=None), "DATASET_DEPTH_MISSING", r"It has /camera/color/image \(sensor_msgs/msg/Image\), "),
        (named(info=None), "DATASET_INTRINSICS_INVALID", "no CameraInfo"),
    ],
)
def test_bags_without_what_is_needed_are_refused(
    change: Change, reason: str, said: str, plain: Path, tmp_path: Path
) -> None:
    with pytest.raises(DatasetError, match=said) as refused:
        open_recording(rewritten(plain, tmp_path / "bag", change))
    assert refused.value.reason == reason


def read_all(path: Path) -> None:
    for frame in open_recording(path).frames:
        frame.read()


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("share", [0.1, 0.6, 0.98])
def test_bags_cut_short_are_refused(storage: str, share: float, tmp_path: Path) -> None:
    folder = writers.bag(tmp_path / "bag", truth(), storage)
    path = next(one for one in folder.iterdir() if one.suffix != ".yaml")
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    for source in (folder, path):
        with pytest.raises(DatasetError, match=f"{source.name} cannot be read as a bag") as refused:
            read_all(source)
        assert refused.value.reason == "DATASET_BAG_INVALID"
        assert str(tmp_path) not in str(refused.value)
