"""Recordings in ROS bags: rosbag2 folders, single .mcap and .db3 files, and .bag files of ROS 1."""

from __future__ import annotations

import io
import math
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from regnf_core.errors import DatasetError, MissingExtraError
from regnf_data.recordings.camera import Array, Camera, camera_of_values, depth_unit
from regnf_data.recordings.folders import interpolated, poses_of
from regnf_data.recordings.recording import MOST_PIXELS, Recording, StoredFrame, recording_of

if TYPE_CHECKING:
    from regnf_data.recordings.recording import Given

_INVALID = "DATASET_BAG_INVALID"
_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _TF = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
_POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_MILLIMETER = 0.001
_NEAREST_S = 0.1
"""Between a depth image and the color image beside it."""
_LONGEST_CHAIN = 64
_DEPTH_HEAD = struct.Struct("<iff")
"""Of a ``compressedDepth`` message: format and two parameters, before the PNG."""


class Bag:
    """A bag that stays open while its frames are used."""

    def __init__(self, path: Path) -> None:
        """Raises DatasetError (DATASET_BAG_INVALID) and MissingExtraError."""
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise MissingExtraError.of(["rosbags"], ["engine"]) from error
        self.name, self._lock = path.name, Lock()
        with self.errors():
            self.reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
            self.reader.open()

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Turns whatever the library raises of a broken file into DatasetError (DATASET_BAG_INVALID)."""
        try:
            yield
        except DatasetError:
            raise
        except Exception as error:
            told = re.sub(r"(/[^\s/]+)+/", "", str(error))  # paths of this machine are nobody's business
            raise DatasetError(f"{self.name} cannot be read as a bag: {told}"[:400], reason=_INVALID) from error

    def of_type(self, *types: str) -> list[Any]:
        """The connections whose messages are of one of the types."""
        return [each for each in self.reader.connections if each.msgtype in types]

    def messages(
        self, connections: Sequence[Any], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Any, int, Any]]:
        """Connection, time (ns) and message of each, in their order."""
        with self.errors():
            for connection, time, raw in self.reader.messages(connections, start, stop):
                yield connection, time, self.reader.deserialize(raw, connection.msgtype)

    def first(self, connection: Any | None) -> Any:
        found = () if connection is None else self.messages([connection])
        return next((message for _, _, message in found), None)

    def at(self, connection: Any, time: int) -> Any:
        """The message of a time. Raises DatasetError (DATASET_BAG_INVALID) where the bag lost it."""
        with self._lock:
            for _, _, message in self.messages([connection], time, time + 1):
                return message
        raise DatasetError(f"{self.name}: no message of {connection.topic} at {time}", reason=_INVALID)

    def times(self, connection: Any) -> Iterator[tuple[int, bytes]]:
        """Time and raw bytes of each message of a connection: nothing is kept."""
        with self.errors():
            for _, time, raw in self.reader.messages([connection]):
                yield time, raw

    def __del__(self) -> None:
        with suppress(Exception):
            self.reader.close()


def _numbers(place: Any, turn: Any) -> tuple[float, ...]:
    return place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w


@dataclass
class Link:
    """From a child's frame to its parent's, over time. stamps: s · values: places and quaternions x y z w."""

    parent: str
    static: bool
    stamps: list[float] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, stamp: Any, place: Any, turn: Any) -> None:
        self.stamps.append(stamp.sec + 1e-9 * stamp.nanosec)
        self.values.append(_numbers(place, turn))

    def at(self, stamps: Array) -> list[Array | None]:
        """T_parent_child at each of the times; None where none is near."""
        values = np.array(self.values)
        poses = poses_of(values[:, :3], values[:, 3:], f"the transform to {self.parent}")
        if self.static:
            return [poses[-1]] * len(stamps)
        order = np.argsort(self.stamps, kind="stable")
        return interpolated(np.array(self.stamps)[order], poses[order], stamps)


def read_bag(path: Path, given: Given) -> Recording:
    """Depth images with the poses of tf, or else of odometry. Streamed: an image is read when its frame is.

    Raises DatasetError: DATASET_BAG_INVALID, DATASET_DEPTH_MISSING, DATASET_INTRINSICS_INVALID, ...
    """
    bag = Bag(path)
    with bag.errors():
        return _recording(bag, path.name, given)


def _recording(bag: Bag, name: str, given: Given) -> Recording:
    depth, notes = _depth_topic(bag, (given.layout or "").partition(":")[2])
    stamps, times, frame_id = _stamps(bag, depth)
    unit = given.depth_unit or _unit(bag, depth.topic)
    info = _info_of(bag, depth)
    camera = given.camera or (_camera(info, depth.topic) if info is not None else None)
    if camera is None:
        raise DatasetError(
            f"{name}: {depth.topic} has no CameraInfo: give --intrinsics fx,fy,cx,cy",
            reason="DATASET_INTRINSICS_INVALID",
        )
    poses, how = _poses(bag, frame_id, stamps)
    notes.append(how)
    color = _color_topic(bag, depth)
    color_times, color_camera, same = _color_side(bag, color, frame_id)
    if color is not None and not same:
        notes.append(f"{color.topic} is assumed to be taken from the position of the depth camera")
    frames: list[StoredFrame | None] = []
    for index, (stamp, time, pose) in enumerate(zip(stamps, times, poses, strict=True)):
        if pose is None:
            frames.append(None)
            continue
        picture = None
        if color is not None and len(color_times[0]):
            nearest = int(np.abs(color_times[0] - stamp).argmin())
            if abs(color_times[0][nearest] - stamp) <= _NEAREST_S:
                picture = _color_reader(bag, color, int(color_times[1][nearest]))
        reader = _depth_reader(bag, depth, time, unit)
        frames.append(StoredFrame(f"{index:06d}", camera, pose, reader, picture, color_camera))
    return recording_of(name, f"a ROS bag, {depth.topic}", frames, notes)


def _depth_topic(bag: Bag, wanted: str) -> tuple[Any, list[str]]:
    """The topic of depth images: by its encoding; those registered to the color first. wanted: its name, or nothing.

    Raises DatasetError (DATASET_DEPTH_MISSING, DATASET_TOPIC_AMBIGUOUS) naming the topics.
    """
    found: dict[str, tuple[Any, str]] = {}
    for connection in bag.of_type(_IMAGE, _COMPRESSED):
        message = bag.first(connection)
        if message is not None and _is_depth(connection.msgtype, message):
            found[connection.topic] = connection, message.header.frame_id or connection.topic.rsplit("/", 1)[0]
    if not found or (wanted and wanted not in found):
        listed = ", ".join(sorted(found or {f"{each.topic} ({each.msgtype})" for each in bag.reader.connections})[:12])
        what = f"depth images on {wanted[:100]}" if wanted else "depth images (16UC1, 32FC1 or compressedDepth)"
        raise DatasetError(
            f"{bag.name} has no {what}. It has {listed or 'no messages'}", reason="DATASET_DEPTH_MISSING"
        )

    def rank(topic: str) -> tuple[bool, bool, bool]:
        lower = topic.lower()
        return ("depth" not in lower, "aligned" not in lower and "registered" not in lower, "infra" in lower)

    topics = sorted(found, key=lambda topic: (rank(topic), -found[topic][0].msgcount, topic))
    best = wanted or topics[0]
    others = [topic for topic in topics if topic != best]
    alike = [topic for topic in others if rank(topic) == rank(best) and found[topic][1] != found[best][1]]
    if alike and not wanted:
        raise DatasetError(
            f"{bag.name} has depth images of several cameras: {', '.join([best, *alike])}",
            reason="DATASET_TOPIC_AMBIGUOUS",
            hint=f"Choose one: --layout rosbag2:{best}",
        )
    return found[best][0], [f"depth is {best}"] + ([f"not used: {', '.join(others)}"] if others else [])


def _is_depth(kind: str, message: Any) -> bool:
    if kind == _IMAGE:
        return message.encoding in ("16UC1", "mono16", "32FC1")
    return "compressedDepth" in message.format or message.format.startswith(("16UC1", "mono16"))


def _unit(bag: Bag, topic: str) -> float | None:
    """Meters a step, as bags of RealSense's own recorder say it beside their images."""
    options = [each for each in bag.of_type("std_msgs/msg/Float32") if "depth_units" in each.topic.lower()]
    message = bag.first(_near_topic(topic, options))
    return None if message is None else depth_unit(float(message.data))


def _stamps(bag: Bag, connection: Any) -> tuple[Array, list[int], str]:
    """Times of the headers (s), times in the bag (ns), and the frame of the camera."""
    stamps: list[float] = []
    times: list[int] = []
    frame = ""
    for time, raw in bag.times(connection):
        if not times:
            with bag.errors():
                first: Any = bag.reader.deserialize(raw, connection.msgtype)
                frame = first.header.frame_id
        # The header comes first: CDR has 4 bytes before it, ROS 1 a counter.
        seconds, nanoseconds = struct.unpack_from("<iI", raw, 4)
        stamps.append(seconds + 1e-9 * nanoseconds if seconds or nanoseconds else 1e-9 * time)
        times.append(time)
    return np.array(stamps), times, frame.lstrip("/")


def _near_topic(topic: str, connections: Sequence[Any]) -> Any | None:
    """The connection whose topic shares the longest beginning with ``topic``; none where not even its first part."""

    def shared(other: str) -> int:
        parts = zip(topic.strip("/").split("/"), other.strip("/").split("/"), strict=False)
        return next((n for n, (a, b) in enumerate(parts) if a != b), min(topic.count("/"), other.count("/")))

    best = max(connections, key=lambda each: shared(each.topic), default=None)
    return best if best is not None and (shared(best.topic) > 0 or len(connections) == 1) else None


def _info_of(bag: Bag, image: Any) -> Any | None:
    """The first CameraInfo beside a topic of images."""
    return bag.first(_near_topic(image.topic, bag.of_type(_INFO)))


def _camera(info: Any, topic: str) -> Camera:
    values = {
        "k": np.asarray(info.K if hasattr(info, "K") else info.k).tolist(),
        "d": np.asarray(info.D if hasattr(info, "D") else info.d).tolist(),
        "distortion_model": info.distortion_model,
        "width": int(info.width),
        "height": int(info.height),
    }
    found = camera_of_values(values, topic)
    if found is None or not any(values["k"]):
        raise DatasetError(f"{topic}: its CameraInfo is all zero", reason="DATASET_INTRINSICS_INVALID")
    return found.camera


# Where the camera stood.


def _poses(bag: Bag, frame: str, stamps: Array) -> tuple[list[Array | None], str]:
    """T_world_camera at the times, and where from."""
    links = _links(bag)
    chain, at = _chain(links, frame)
    if any(not link.static for link in chain):
        return _chained(chain, stamps), f"poses are from tf, {at!r} to {frame!r}"
    odometry = bag.of_type(*_POSES)
    if odometry:
        best = max(odometry, key=lambda each: (each.msgtype == _POSES[0], each.msgcount))
        body, child = _odometry(bag, best)
        below, at = _chain(links, frame, child)
        if child and at != child:
            below = []
        return _chained([*below, body], stamps), f"poses are from {best.topic}" + (
            ""
            if not child or below or frame == child
            else f", assumed to be those of the camera: tf has no transform from {child!r} to {frame!r}"
        )
    if len(stamps) == 1 or chain:
        return _chained(chain, stamps), "tf and odometry do not change: the camera is assumed to be static"
    return [np.eye(4) for _ in stamps], "the bag has no poses: register in one frame at a time"


def _chain(links: dict[str, Link], frame: str, top: str | None = None) -> tuple[list[Link], str]:
    """The links from a frame up to ``top``, or as far as they go, and the frame at their end."""
    chain: list[Link] = []
    while frame in links and frame != top and len(chain) < _LONGEST_CHAIN:
        chain.append(links[frame])
        frame = links[frame].parent
    return chain, frame


def _links(bag: Bag) -> dict[str, Link]:
    links: dict[str, Link] = {}
    connections = bag.of_type(_TF)
    for connection, _, message in bag.messages(connections) if connections else ():
        static = connection.topic.endswith("tf_static")
        for each in message.transforms:
            child, parent = each.child_frame_id.lstrip("/"), each.header.frame_id.lstrip("/")
            link = links.setdefault(child, Link(parent, static))
            link.static &= static
            link.add(each.header.stamp, each.transform.translation, each.transform.rotation)
    return links


def _odometry(bag: Bag, connection: Any) -> tuple[Link, str]:
    link, child = Link("world", False), ""
    for _, _, message in bag.messages([connection]):
        pose = message.pose
        while hasattr(pose, "pose"):
            pose = pose.pose
        child = getattr(message, "child_frame_id", "").lstrip("/")
        if all(map(math.isfinite, _numbers(pose.position, pose.orientation))):
            link.add(message.header.stamp, pose.position, pose.orientation)
    if not link.values:
        raise DatasetError(f"{bag.name}: {connection.topic} has no pose of finite numbers", reason="DATASET_NO_FRAMES")
    return link, child


def _chained(chain: Sequence[Link], stamps: Array) -> list[Array | None]:
    """The product of the links, from the camera's up, at each time."""
    poses: list[Array | None] = [np.eye(4) for _ in stamps]
    for link in chain:
        above = link.at(stamps)
        poses = [None if one is None or up is None else up @ one for one, up in zip(poses, above, strict=True)]
    return poses


# Images.


def _depth_reader(bag: Bag, connection: Any, time: int, unit: float | None) -> Any:
    def read() -> NDArray[np.float32]:
        message = bag.at(connection, time)
        name = f"{connection.topic} at {time}"
        if connection.msgtype == _COMPRESSED:
            return _compressed_depth(message, name, unit or _MILLIMETER)
        return _meters(_pixels(message, name), unit or _MILLIMETER)

    return read


def _meters(stored: NDArray[Any], unit: float) -> NDArray[np.float32]:
    if stored.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            return np.where(np.isfinite(stored) & (stored > 0.0), stored, 0.0).astype(np.float32)
    return np.where(stored < np.iinfo(stored.dtype).max, stored * unit, 0.0).astype(np.float32)


def _compressed_depth(message: Any, name: str, unit: float) -> NDArray[np.float32]:
    """A PNG, by compressedDepth behind 12 bytes; 32FC1 holds inverse depths: a / (value - b)."""
    data = bytes(message.data)
    if "compressedDepth" not in message.format:
        data = bytes(_DEPTH_HEAD.size) + data
    if "rvl" in message.format.lower() or len(data) < _DEPTH_HEAD.size:
        raise DatasetError(
            f"{name}: depth compressed as {message.format!r:.60} is not supported", reason="DATASET_IMAGE_INVALID"
        )
    _, a, b = _DEPTH_HEAD.unpack_from(data)
    stored = _decoded(data[_DEPTH_HEAD.size :], name)
    if stored.ndim != 2:
        raise DatasetError(f"{name}: the depth image has more than one channel", reason="DATASET_IMAGE_INVALID")
    if not message.format.startswith("32FC1"):
        return _meters(stored.astype(np.uint16), unit)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(stored > 0, a / (stored.astype(np.float32) - b), 0.0).astype(np.float32)


def _decoded(data: bytes, name: str) -> NDArray[Any]:
    try:
        with Image.open(io.BytesIO(data)) as image:
            if image.width * image.height > MOST_PIXELS:
                raise DatasetError(f"{name} has {image.width} x {image.height} pixels", reason="DATASET_TOO_LARGE")
            return np.asarray(image)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DatasetError(f"{name} cannot be read as an image: {error}", reason="DATASET_IMAGE_INVALID") from error


_CODINGS = {
    "16UC1": ("u2", 1), "mono16": ("u2", 1), "32FC1": ("f4", 1), "mono8": ("u1", 1), "8UC1": ("u1", 1),
    "rgb8": ("u1", 3), "bgr8": ("u1", 3), "8UC3": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4), "8UC4": ("u1", 4),
}  # fmt: skip


def _pixels(message: Any, name: str) -> NDArray[Any]:
    """(H, W) or (H, W, C) of a sensor_msgs/Image."""
    if message.encoding not in _CODINGS:
        raise DatasetError(
            f"{name}: images of the encoding {message.encoding!r:.40} are not supported", reason="DATASET_IMAGE_INVALID"
        )
    kind, channels = _CODINGS[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, np.uint8)
    row = width * channels * dtype.itemsize
    if height * width > MOST_PIXELS or step < row or len(data) < height * step or height * width == 0:
        raise DatasetError(f"{name}: {len(data)} bytes for {width} x {height} pixels", reason="DATASET_IMAGE_INVALID")
    rows = data[: height * step].reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)
    return pixels[..., 0] if channels == 1 else pixels


def _color_topic(bag: Bag, depth: Any) -> Any | None:
    """The color images nearest to the depth images by the names of their topics."""
    found = []
    for connection in bag.of_type(_IMAGE, _COMPRESSED):
        if connection.topic == depth.topic:
            continue
        message = bag.first(connection)
        coding = "" if message is None else message.encoding if connection.msgtype == _IMAGE else message.format
        is_file = ("jpeg" in coding or "png" in coding) and "Depth" not in coding
        if is_file or coding in ("rgb8", "bgr8", "rgba8", "bgra8", "8UC3", "8UC4"):
            found.append(connection)
    return _near_topic(depth.topic, found)


def _color_side(bag: Bag, color: Any | None, depth_frame: str) -> tuple[tuple[Array, Array], Camera | None, bool]:
    """Stamps and bag times of the color images, their camera, and whether it is the depth camera's own place."""
    if color is None:
        return (np.zeros(0), np.zeros(0)), None, True
    stamps, times, frame = _stamps(bag, color)
    info = _info_of(bag, color)
    return (stamps, np.array(times)), None if info is None else _camera(info, color.topic), frame == depth_frame


def _color_reader(bag: Bag, connection: Any, time: int) -> Any:
    def read() -> NDArray[np.uint8]:
        message, name = bag.at(connection, time), f"{connection.topic} at {time}"
        if connection.msgtype == _COMPRESSED:
            pixels = _decoded(bytes(message.data), name)
            swapped = False  # files of images are red first, whatever the format's text says of the sender's memory
        else:
            pixels, swapped = _pixels(message, name), message.encoding.startswith("bgr")
        if pixels.ndim == 2:
            pixels = np.repeat(pixels[..., None], 3, axis=2)
        pixels = pixels[..., :3]
        return np.ascontiguousarray(pixels[..., ::-1] if swapped else pixels, np.uint8)

    return read
