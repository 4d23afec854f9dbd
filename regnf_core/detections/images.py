"""Detections in images: masks, boxes in pixels and points, in the forms that detectors write.

    {"frame": "000003", "box_2d": [left, top, right, bottom]}
    {"frame": 3, "point_2d": [u, v]}
    {"mask": "mask.png" | a PNG as base64 | {"size": [h, w], "counts": ...} | [[x, y, x, y, ...], ...]}

COCO's annotations and results, ultralytics' export and BOP's results are read too. Light: masks stay as they are
written until an image is at hand.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from regnf_core.detections.bounds import Detection
from regnf_core.detections.parsing import parse_detection
from regnf_core.errors import InvalidDetectionError

HINT = (
    'Write for example {"frame": "000003", "box_2d": [left, top, right, bottom]}, {"mask": "mask.png"} or'
    ' {"point_2d": [u, v]}, in pixels.'
)
_NAMES = ("mask", "box_2d", "point_2d", "segmentation", "segments", "annotations")
_ENDING = re.compile(r"\.(png|jpe?g|tiff?|bmp|webp|np[yz]|exr)$", re.IGNORECASE)
_MOST_MASK_BYTES = 4 << 20
"""Of a mask's file that is put into a detection."""
_MOST_DETECTIONS = 10_000


@dataclass(frozen=True, eq=False)
class ImageDetection:
    """An object in one image. Exactly one of mask, box_2d and point_2d is given, in pixels of the color image, or of
    the depth image if a frame has no color.

    frame: its name or number · mask: as it was written, or an array (H, W), true on the object · size: height and width
    of the image, for polygons · box_2d: left, top, right, bottom · point_2d: u, v.
    """

    frame: str | int = 0
    mask: Any = None
    box_2d: tuple[float, float, float, float] | None = None
    point_2d: tuple[float, float] | None = None
    size: tuple[int, int] | None = None
    label: str | None = None
    score: float | None = None

    def __post_init__(self) -> None:
        if sum(value is not None for value in (self.mask, self.box_2d, self.point_2d)) != 1:
            raise InvalidDetectionError(
                "a detection in an image needs exactly one of mask, box_2d and point_2d", hint=HINT
            )

    def values(self) -> dict[str, Any]:
        """Plain (JSON) values, without members that were not given."""
        found: dict[str, Any] = {"frame": self.frame}
        for name in ("mask", "box_2d", "point_2d", "size", "label", "score"):
            value = getattr(self, name)
            if value is not None:
                found[name] = list(value) if isinstance(value, tuple) else value
        return found

    def beside(self, folder: Path) -> ImageDetection:
        """The same with a mask that is named as a file of ``folder`` as text, to be sent.

        Raises InvalidDetectionError.
        """
        if not isinstance(self.mask, str) or len(self.mask) > 1000 or not (folder / self.mask).is_file():
            return self
        data = (folder / self.mask).read_bytes()
        if len(data) > _MOST_MASK_BYTES:
            raise InvalidDetectionError(f"the mask {self.mask} has {len(data) >> 20} MiB", hint="Write it as a PNG.")
        return replace(self, mask=base64.b64encode(data).decode())


def is_image_detection(values: Any) -> bool:
    """Whether a detection's JSON is about an image: it has a mask, a box in pixels or a point."""
    first = values[0] if isinstance(values, list | tuple) and values else values
    if isinstance(first, ImageDetection):
        return True
    if not isinstance(first, Mapping):
        return False
    box, flat = first.get("box"), first.get("bbox")
    in_pixels = (isinstance(box, Mapping) and "x1" in box) or (isinstance(flat, list | tuple) and len(flat) == 4)
    return in_pixels or any(key in first for key in _NAMES)


AnyDetection = Detection | tuple[ImageDetection, ...]
"""A box in the scene's frame; or one object in one image, or in several."""


def read_detection(values: Any, index: int | None = None, folder: Path | None = None) -> AnyDetection:
    """A detection of either kind. index: its position in a list · folder: the folder of mask files; their content is
    put into the detection.

    Raises InvalidDetectionError.
    """
    if not is_image_detection(values):
        return parse_detection(values, index)
    found = read_image_detections(values, index)
    return found if folder is None else tuple(one.beside(folder) for one in found)


def place_of_frame(names: Sequence[str], wanted: str) -> int | None:
    """The place of the frame of a name, with or without the ending of an image; of the number in a name, else of a
    place. None where there is none."""
    bare = [_ENDING.sub("", PurePosixPath(name).name) for name in names]
    for place, name in enumerate(names):
        if wanted in (name, PurePosixPath(name).name) or _ENDING.sub("", wanted) == bare[place]:
            return place
    if not (wanted.isascii() and wanted.isdecimal()):
        return None
    numbers = [one.lstrip("0") for one in bare]
    number = wanted.lstrip("0")
    place = numbers.index(number) if number in numbers else int(number[:9] or 0)
    return place if place < len(names) else None


def image_detection_in_field(scene: object = "the scene") -> InvalidDetectionError:
    """The error for a mask, a box in pixels or a point where the scene has no images."""
    return InvalidDetectionError(
        f"the detection is in an image, but {scene} is a field", reason="IMAGE_DETECTION_WITHOUT_RECORDING"
    )


def plain_values(detection: AnyDetection) -> Any:
    """JSON values that ``read_detection`` reads again: what a request holds."""
    return detection.canonical() if isinstance(detection, Detection) else [one.values() for one in detection]


def read_image_detections(values: Any, index: int | None = None) -> tuple[ImageDetection, ...]:
    """The detections of one object in a document: regnf's own form, COCO's annotations or results, ultralytics' export,
    BOP's results. index: of a detector's list, which one; None: the only one, of ours all, which are of one object in
    several frames.

    Raises InvalidDetectionError.
    """
    listed = values.get("annotations", values) if isinstance(values, Mapping) else values
    entries = list(listed) if isinstance(listed, list | tuple) else [listed]
    if entries and all(isinstance(entry, ImageDetection) for entry in entries):
        return tuple(entries)
    if not entries or len(entries) > _MOST_DETECTIONS or not all(isinstance(entry, Mapping) for entry in entries):
        raise InvalidDetectionError("the list of detections is empty", hint=HINT)
    ours = all(any(key in entry for key in ("mask", "box_2d", "point_2d")) for entry in entries)
    if index is not None:
        if not 0 <= index < len(entries):
            raise InvalidDetectionError(f"there is no detection {index}: the list has {len(entries)}")
        entries = [entries[index]]
    elif not ours and len(entries) > 1:
        known = ", ".join(f"{n}: {_name(entry)}" for n, entry in enumerate(entries[:8]))
        raise InvalidDetectionError(
            f"there are {len(entries)} detections; choose one ({known})", hint="Give --detection-index."
        )
    images, categories = (_listed(values, name) for name in ("images", "categories"))
    return tuple(_read(entry, images, categories) for entry in entries)


def _listed(values: Any, name: str) -> dict[Any, Mapping[str, Any]]:
    """COCO's images or categories, by their numbers."""
    listed = values.get(name) if isinstance(values, Mapping) else None
    return {one.get("id"): one for one in listed or () if isinstance(one, Mapping)}


def _name(entry: Mapping[str, Any]) -> str:
    return str(next((entry[key] for key in ("label", "name", "category_id", "class") if key in entry), "no label"))[:40]


def _read(
    entry: Mapping[str, Any], images: Mapping[Any, Mapping[str, Any]], categories: Mapping[Any, Mapping[str, Any]]
) -> ImageDetection:
    image = images.get(entry.get("image_id"), {})
    frame = next((entry[key] for key in ("frame", "image_id", "file_name", "image") if key in entry), 0)
    frame = PurePosixPath(str(image["file_name"])).name if "file_name" in image else frame
    if isinstance(frame, bool) or not isinstance(frame, str | int):
        raise InvalidDetectionError("frame is neither a name nor a number", hint=HINT)
    score = next((entry[key] for key in ("score", "confidence") if key in entry), None)
    label = next((str(entry[key]) for key in ("label", "name", "category_id", "class") if key in entry), None)
    label = str(categories.get(entry.get("category_id"), {}).get("name", label)) if label else None
    size = entry.get("size") or entry.get("image_size")
    if not size and "height" in image and "width" in image:
        size = image["height"], image["width"]
    common: dict[str, Any] = {
        "frame": frame,
        "label": label,
        "score": None if score is None else _numbers([score], 1, "score")[0],
        "size": None if size is None else tuple(int(side) for side in _numbers(size, 2, "size")),
    }
    for key in ("mask", "segmentation"):
        if entry.get(key) is not None and not (isinstance(entry[key], list) and not entry[key]):
            return ImageDetection(mask=entry[key], **common)
    segments = entry.get("segments")
    if isinstance(segments, Mapping) and segments.get("x"):
        x, y = (_numbers(segments.get(axis), None, f"segments.{axis}") for axis in "xy")
        return ImageDetection(mask=[[value for pair in zip(x, y, strict=False) for value in pair]], **common)
    if entry.get("point_2d") is not None:
        u, v = _numbers(entry["point_2d"], 2, "point_2d")
        return ImageDetection(point_2d=(u, v), **common)
    if entry.get("box_2d") is not None:
        corners = _numbers(entry["box_2d"], 4, "box_2d")
    elif isinstance(entry.get("box"), Mapping):
        corners = _numbers([entry["box"].get(key) for key in ("x1", "y1", "x2", "y2")], 4, "box")
    elif entry.get("bbox") is not None:
        left, top, width, height = _numbers(entry["bbox"], 4, "bbox")
        corners = [left, top, left + width, top + height]
    else:
        raise InvalidDetectionError("a detection in an image needs a mask, a box_2d or a point_2d", hint=HINT)
    if not (corners[0] < corners[2] and corners[1] < corners[3]):
        raise InvalidDetectionError(
            f"the box {corners} has no area; the order is left, top, right, bottom, in pixels", hint=HINT
        )
    return ImageDetection(box_2d=(corners[0], corners[1], corners[2], corners[3]), **common)


def _numbers(value: Any, count: int | None, what: str) -> list[float]:
    try:
        given: Sequence[Any] = () if isinstance(value, str | Mapping) else list(value)
        numbers = [float(each) for each in given if not isinstance(each, bool | str)]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != (count or len(numbers)) or not numbers or not all(map(math.isfinite, numbers)):
        raise InvalidDetectionError(f"{what} is not {count or 'a list of'} finite numbers", hint=HINT)
    return numbers
