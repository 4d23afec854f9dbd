"""Depth images, color images and detections of one time, put together by their stamps. No ROS.

A detector answers when its image has long passed, and depth may come before or after its answer. message_filters would
have to keep as many whole sets; here detections wait for a depth image, and images are kept as memory allows.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

NEAREST_NS = 100_000_000
"""Between detections and the depth image that is taken to be of the same time, at most."""
MOST_BYTES = 128 << 20
"""Of the images of one topic that are kept, some seconds of them."""
MOST_WAITING = 16
"""Arrays of detections that wait for a depth image."""
BACK_NS = 1_000_000_000
"""A stamp that lies so much before the last one begins again: a recording was started again."""


@dataclass(frozen=True, eq=False)
class Shot:
    """Messages of one time: sensor_msgs/Image, CameraInfo, Image or None, and an array of detections.

    color_size: height and width of color images, if any came, of whatever time.
    """

    depth: Any
    info: Any
    color: Any | None
    detections: Any
    color_size: tuple[int, int] | None = None


def stamp_of(message: Any) -> int:
    """ns of a message's header."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


class Images:
    """The last images of a topic."""

    def __init__(self) -> None:
        self._kept: deque[tuple[int, Any]] = deque()
        self._bytes = 0

    def add(self, message: Any) -> None:
        stamp = stamp_of(message)
        if self._kept and stamp < self._kept[-1][0] - BACK_NS:
            self._kept.clear()
            self._bytes = 0
        self._kept.append((stamp, message))
        self._bytes += len(message.data)
        while self._bytes > MOST_BYTES and len(self._kept) > 1:
            self._bytes -= len(self._kept.popleft()[1].data)

    def reached(self, stamp: int) -> bool:
        """Whether no image will come that is nearer to ``stamp``: images come in their order."""
        return bool(self._kept) and self._kept[-1][0] >= stamp

    def near(self, stamp: int) -> Any | None:
        """The image nearest in time; None where none is near."""
        best = min(self._kept, key=lambda kept: abs(kept[0] - stamp), default=None)
        return best[1] if best is not None and abs(best[0] - stamp) <= NEAREST_NS else None

    def first(self) -> int:
        """The stamp of the oldest image that is kept."""
        return self._kept[0][0]


class Matcher:
    """Gives each array of detections its images. Depth and detections may complete shots, which are returned.

    say: called with the reason why detections are dropped.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._depths, self._colors = Images(), Images()
        self._info: Any | None = None
        self._color_size: tuple[int, int] | None = None
        self._waiting: deque[Any] = deque()

    def add_info(self, message: Any) -> None:
        self._info = message

    def add_color(self, message: Any) -> None:
        self._colors.add(message)
        if message.height and message.width:
            self._color_size = int(message.height), int(message.width)

    def add_depth(self, message: Any) -> list[Shot]:
        self._depths.add(message)
        return self._complete()

    def add_detections(self, message: Any) -> list[Shot]:
        if not message.detections:
            return []
        if stamp_of(message) == 0:
            self._say("detections without a time stamp are dropped: the detector must copy the header of its image")
            return []
        self._waiting.append(message)
        if len(self._waiting) > MOST_WAITING:
            lacking = "camera_info" if self._info is None else "later depth image"
            self._say(
                f"no {lacking} has arrived for the oldest of {MOST_WAITING} waiting detection arrays: it is dropped"
            )
            self._waiting.popleft()
        return self._complete()

    def _complete(self) -> list[Shot]:
        shots, waiting = [], deque[Any]()
        for message in self._waiting:
            stamp = stamp_of(message)
            if self._info is None or not self._depths.reached(stamp):
                waiting.append(message)
                continue
            depth = self._depths.near(stamp)
            if depth is not None:
                shots.append(Shot(depth, self._info, self._colors.near(stamp), message, self._color_size))
            elif stamp < self._depths.first():
                late = 1e-9 * (self._depths.first() - stamp)
                self._say(f"detections arrived too late: the oldest stored depth image is {late:.1f} s newer")
            else:
                self._say(f"no depth image is within {1e-9 * NEAREST_NS:g} s of the detections")
        self._waiting = waiting
        return shots
