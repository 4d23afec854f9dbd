"""Detections in images: masks, boxes in pixels and points, as detectors write them, lifted to boxes in space."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from regnf_core.errors import InvalidDetectionError
from regnf_core.geometry.box import OrientedBox
from regnf_data.recordings.camera import Array, Size
from regnf_data.recordings.recording import MOST_PIXELS, Frame, mask_file

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class ImageDetection:
    """A thing in one image. One of mask, box and point is given; in pixels of the color image, of the depth image where
    a frame has no color.

    frame: its name or number · mask: (H, W), true on the thing · box: left, top, right, bottom · point: u, v.
    """

    frame: str | int = 0
    mask: Mask | None = None
    box: tuple[float, float, float, float] | None = None
    point: tuple[float, float] | None = None
    label: str | None = None
    score: float | None = None

    def __post_init__(self) -> None:
        if sum(value is not None for value in (self.mask, self.box, self.point)) != 1:
            raise InvalidDetectionError("a detection in an image has one of mask, box_2d and point_2d", hint=_HINT)


_HINT = (
    'Write for example {"frame": "000003", "box_2d": [left, top, right, bottom]}, {"mask": "mask.png"} or'
    ' {"point_2d": [u, v]}, in pixels.'
)


def is_image_detection(values: Any) -> bool:
    """Whether a detection's JSON is about an image: it has a mask, a box in pixels or a point."""
    first = values[0] if isinstance(values, list) and values else values
    return isinstance(first, Mapping) and any(
        key in first for key in ("mask", "box_2d", "point_2d", "segmentation", "bbox", "segments", "box", "annotations")
    )


def read_image_detections(
    values: Any, folder: Path | None = None, index: int | None = None
) -> tuple[ImageDetection, ...]:
    """The detections of one thing in a document: regnf's own form, COCO's annotations or results, ultralytics' export,
    BOP's results. folder: of masks that are named as files · index: of a detector's list, which one; None: the only
    one, of ours all, which are of one thing in several frames.

    Raises InvalidDetectionError.
    """
    listed = values.get("annotations", values) if isinstance(values, Mapping) else values
    entries = list(listed) if isinstance(listed, list) else [listed]
    if not entries or not all(isinstance(entry, Mapping) for entry in entries):
        raise InvalidDetectionError("no detection is listed", hint=_HINT)
    ours = all(any(key in entry for key in ("mask", "box_2d", "point_2d")) for entry in entries)
    if index is not None:
        if not 0 <= index < len(entries):
            raise InvalidDetectionError(f"there is no detection {index}: {len(entries)} are listed")
        entries = [entries[index]]
    elif not ours and len(entries) > 1:
        known = ", ".join(f"{n}: {_name(entry)}" for n, entry in enumerate(entries[:8]))
        raise InvalidDetectionError(
            f"{len(entries)} detections are listed: say which ({known})", hint="Give --detection-index."
        )
    return tuple(_read(entry, folder) for entry in entries)


def _name(entry: Mapping[str, Any]) -> str:
    return str(next((entry[key] for key in ("label", "name", "category_id", "class") if key in entry), "no label"))[:40]


def _read(entry: Mapping[str, Any], folder: Path | None) -> ImageDetection:
    frame = next((entry[key] for key in ("frame", "image_id", "file_name", "image") if key in entry), 0)
    score = next((entry[key] for key in ("score", "confidence") if key in entry), None)
    label = next((str(entry[key]) for key in ("label", "name", "category_id", "class") if key in entry), None)
    common = {"frame": frame, "label": label, "score": None if score is None else float(score)}
    size = entry.get("size") or entry.get("image_size")
    for key in ("mask", "segmentation"):
        if entry.get(key) is not None:
            return ImageDetection(mask=mask_of(entry[key], folder, size), **common)
    segments = entry.get("segments")
    if isinstance(segments, Mapping) and segments.get("x"):
        polygon = np.stack([np.array(segments["x"], float), np.array(segments["y"], float)], axis=1)
        return ImageDetection(mask=_polygon([polygon.ravel().tolist()], size), **common)
    if entry.get("point_2d") is not None:
        u, v = _numbers(entry["point_2d"], 2, "point_2d")
        return ImageDetection(point=(u, v), **common)
    if entry.get("box_2d") is not None:
        corners = _numbers(entry["box_2d"], 4, "box_2d")
    elif isinstance(entry.get("box"), Mapping):
        corners = _numbers([entry["box"].get(key) for key in ("x1", "y1", "x2", "y2")], 4, "box")
    elif entry.get("bbox") is not None:
        left, top, width, height = _numbers(entry["bbox"], 4, "bbox")
        corners = [left, top, left + width, top + height]
    else:
        raise InvalidDetectionError("a detection in an image has a mask, a box_2d or a point_2d", hint=_HINT)
    if not (corners[0] < corners[2] and corners[1] < corners[3]):
        raise InvalidDetectionError(
            f"the box {corners} has no area: it is left, top, right, bottom in pixels", hint=_HINT
        )
    return ImageDetection(box=(corners[0], corners[1], corners[2], corners[3]), **common)


def _numbers(value: Any, count: int, what: str) -> list[float]:
    try:
        numbers = [float(each) for each in value]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InvalidDetectionError(f"{what} is not {count} finite numbers", hint=_HINT)
    return numbers


def mask_of(value: Any, folder: Path | None = None, size: Any = None) -> Mask:
    """(H, W): of a file's name, a PNG as base64, COCO's run lengths or polygons. size: height and width, for polygons.

    Raises InvalidDetectionError.
    """
    if isinstance(value, np.ndarray):
        if value.ndim != 2:
            raise InvalidDetectionError(f"the mask has the shape {value.shape}, expected (height, width)")
        return np.asarray(value > 0)
    if isinstance(value, Mapping):
        return _run_lengths(value)
    if isinstance(value, list):
        return _polygon(value, size)
    if isinstance(value, str) and folder is not None and len(value) < 1000 and (folder / value).is_file():
        return mask_file(folder / value)
    if isinstance(value, str) and len(value) > 64:
        try:
            data = base64.b64decode(value.partition("base64,")[2] or value, validate=True)
            with Image.open(io.BytesIO(data)) as image:
                if image.width * image.height <= MOST_PIXELS:
                    return np.asarray(image.convert("L")) > 0
        except (OSError, ValueError, SyntaxError) as error:
            raise InvalidDetectionError(f"the mask is no image as base64: {error}"[:200]) from error
    raise InvalidDetectionError("the mask is no file, no image as base64 and no run lengths of COCO", hint=_HINT)


def _run_lengths(value: Mapping[str, Any]) -> Mask:
    """COCO's: lengths of runs of 0 and 1 in turn, down the columns; as numbers or as text of five bits each."""
    try:
        height, width = (int(side) for side in value["size"])
        counts = value["counts"]
        lengths = _text_lengths(counts) if isinstance(counts, str) else [int(count) for count in counts]
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InvalidDetectionError(f"the mask's run lengths cannot be read: {error}") from error
    within = height > 0 and width > 0 and height * width <= MOST_PIXELS
    if not within or min(lengths, default=0) < 0 or sum(lengths) != height * width:
        raise InvalidDetectionError(f"the mask's runs have {sum(lengths)} pixels, its size {width} x {height}")
    flat = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    return flat.reshape(width, height).T


def _text_lengths(text: str) -> list[int]:
    lengths: list[int] = []
    at = 0
    while at < len(text):
        value, shift, more = 0, 0, True
        while more:
            code = ord(text[at]) - 48
            value |= (code & 0x1F) << shift
            more = bool(code & 0x20)
            at, shift = at + 1, shift + 5
            if not more and code & 0x10:
                value |= -1 << shift
        # From the third on, numbers are differences from the one before the last.
        lengths.append(value + (lengths[-2] if len(lengths) > 2 else 0))
    return lengths


def _polygon(polygons: Sequence[Any], size: Any) -> Mask:
    try:
        flat = [[float(number) for number in polygon] for polygon in polygons]
        reach = max(max(polygon) for polygon in flat)
        height, width = (int(side) for side in size) if size else (int(reach) + 2, int(reach) + 2)
    except (TypeError, ValueError) as error:
        raise InvalidDetectionError("the mask's polygons are not lists of x, y, x, y ...", hint=_HINT) from error
    if any(len(polygon) < 6 or len(polygon) % 2 for polygon in flat) or not 0 < height * width <= MOST_PIXELS:
        raise InvalidDetectionError("a mask's polygon has three corners at least", hint=_HINT)
    image = Image.new("1", (width, height))
    for polygon in flat:
        ImageDraw.Draw(image).polygon(polygon, fill=1)
    return np.asarray(image)


# Lifting.

_FEWEST = 30
"""Measured pixels of a thing, at least."""
_JUMP = 0.02
"""A share of the depth: neighbors that differ by more lie on different surfaces."""
_RING = 0.3
"""Of a box's sides: how far around it the background is looked at."""
_TRIALS, _PLANES = 200, 3
_ON_PLANE = 0.008
"""A share of the depth: what lies nearer to a plane of the background belongs to it."""
_PLANE_SHARE = 0.15
"""Of the ring's pixels, to be a plane of the background."""
_NEARBY = 12
"""Pixels in which a measured one is looked for, where a click met none."""
_TRIMMED = 0.01
_LOOSE = 0.1
"""Of the box's size, on each side together: what a detector's mask cuts off, and the sensor's noise."""


@dataclass(frozen=True, eq=False)
class Lifted:
    """box: around the thing, in the world · points: (P, 3), of its surface, world · pixels: (H, W) of the depth image,
    those of the thing · frame: in which."""

    box: OrientedBox
    points: Array
    pixels: Mask
    frame: Frame
    notes: tuple[str, ...] = field(default=())


def lift(frame: Frame, detection: ImageDetection, diameter: float | None = None) -> Lifted:
    """The thing of a detection, in space. diameter: of the known object, m, where its size is known.

    The depth in a mask, in a box or around a point falls into connected surfaces; without a mask, those that lie on
    the planes around (a table, a wall) are left out. The thing is the surface that fills most of it. Its box has the
    camera's axes; behind, it reaches as far as the thing is wide, since its back was not seen.
    Raises InvalidDetectionError, naming the frame, for detections without depth or of another size than the image.
    """
    region, seed = _region(frame, detection)
    measured = region & (frame.depth > 0.0)
    if measured.sum() < _FEWEST:
        share = f"{int(measured.sum())} of {int(region.sum())} pixels"
        raise InvalidDetectionError(
            f"frame {frame.name}: {share} of the detection have a measured depth", reason="DETECTION_WITHOUT_DEPTH"
        )
    if detection.point is not None and seed is not None and diameter is not None:
        # Nothing of a thing that was clicked on is farther from the click than its diameter.
        here = _points(frame, measured)
        rows, columns = np.nonzero(measured)
        clicked = here[np.hypot(rows - seed[0], columns - seed[1]).argmin()]
        region = region & (frame.depth > 0.0)
        region[rows, columns] = np.linalg.norm(here - clicked, axis=1) <= diameter
        measured = region.copy()
    if detection.mask is None:
        measured = _without_background(frame, region, measured)
    pixels = _largest(frame.depth, measured, seed, detection.point is not None)
    camera_points = _points(frame, pixels)
    if diameter is not None and detection.mask is None:
        # Nothing of the thing is farther from its middle than its diameter.
        near = np.linalg.norm(camera_points - np.median(camera_points, axis=0), axis=1) <= diameter
        camera_points = camera_points[near]
    if len(camera_points) < _FEWEST:
        raise InvalidDetectionError(
            f"frame {frame.name}: {len(camera_points)} pixels of the thing have a measured depth",
            reason="DETECTION_WITHOUT_DEPTH",
        )
    low, high = (np.quantile(camera_points, share, axis=0) for share in (_TRIMMED, 1.0 - _TRIMMED))
    behind = max(float((high - low)[:2].max()), diameter or 0.0)
    high[2] = max(high[2], low[2] + behind)
    size = (high - low) * (1.0 + _LOOSE)
    R, t = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3]
    center, axes = torch.from_numpy(R @ ((low + high) / 2.0) + t), torch.from_numpy(R.copy())
    box = OrientedBox(center, torch.from_numpy(size), axes, detection.label, detection.score)
    return Lifted(box, camera_points @ R.T + t, pixels, frame)


def _region(frame: Frame, detection: ImageDetection) -> tuple[Mask, tuple[float, float] | None]:
    """(H, W) of the depth image: the pixels that the detection is about, and the pixel (row, column) it points at."""
    given: Size = frame.depth.shape if frame.color is None else frame.color.shape[:2]  # type: ignore[assignment]
    height, width = given
    mask, seed = detection.mask, None
    if mask is not None:
        if mask.shape != given:
            raise InvalidDetectionError(
                f"frame {frame.name}: the mask has {mask.shape[1]} x {mask.shape[0]} pixels, not {width} x {height}"
            )
        if not mask.any():
            raise InvalidDetectionError(f"frame {frame.name}: the mask is empty")
        return frame.registered(mask), None
    mask = np.zeros(given, dtype=np.bool_)
    if detection.box is not None:
        left, top, right, bottom = detection.box
        columns, rows = (np.clip([a, b], 0, side) for a, b, side in ((left, right, width), (top, bottom, height)))
        mask[int(rows[0]) : int(np.ceil(rows[1])), int(columns[0]) : int(np.ceil(columns[1]))] = True
        if not mask.any():
            raise InvalidDetectionError(f"frame {frame.name}: the box lies outside the image, {width} x {height}")
        middle = ((rows[0] + rows[1]) / 2.0, (columns[0] + columns[1]) / 2.0)
    else:
        assert detection.point is not None
        u, v = detection.point
        if not (0 <= u < width and 0 <= v < height):
            raise InvalidDetectionError(
                f"frame {frame.name}: the point ({u:g}, {v:g}) lies outside the image of {width} x {height} pixels"
            )
        mask[:] = True
        middle = (v, u)
    point = np.zeros(given, dtype=np.bool_)
    point[int(min(middle[0], height - 1)), int(min(middle[1], width - 1))] = True
    rows, columns = np.nonzero(frame.registered(ndimage.binary_dilation(point, iterations=2)))
    if len(rows):
        seed = (float(rows.mean()), float(columns.mean()))
    return frame.registered(mask), seed


def _without_background(frame: Frame, region: Mask, measured: Mask) -> Mask:
    """Without what lies on the planes that most of the surroundings lie on."""
    rows, columns = np.nonzero(region)
    low, high = np.array([rows.min(), columns.min()]), np.array([rows.max(), columns.max()]) + 1
    reach = np.ceil(_RING * (high - low)).astype(int)
    ring = np.zeros_like(region)
    first, last = np.maximum(low - reach, 0), high + reach
    ring[first[0] : last[0], first[1] : last[1]] = True
    around = ring & (frame.depth > 0.0) & (~region | region.all())
    if around.sum() < 3 * _FEWEST:
        return measured
    rng = np.random.default_rng(0)
    inside, points = _points(frame, measured), _points(frame, around)
    kept = np.ones(len(inside), dtype=np.bool_)
    left = points[rng.permutation(len(points))[:5000]]
    total = len(left)
    for _ in range(_PLANES):
        plane = _plane(left, rng)
        if plane is None:
            break
        normal, offset = plane
        on = np.abs(left @ normal - offset) <= _ON_PLANE * left[:, 2]
        if on.sum() < _PLANE_SHARE * total:
            break
        # Behind a plane, seen from the camera at the origin, is background too.
        side = np.sign(offset) or 1.0
        kept &= side * (offset - inside @ normal) > _ON_PLANE * inside[:, 2]
        left = left[~on]
    if kept.sum() < _FEWEST:
        return measured
    out = np.zeros_like(measured)
    out[measured] = kept
    return out


def _plane(points: Array, rng: np.random.Generator) -> tuple[Array, float] | None:
    """The plane n x = d that most of points (P, 3) lie on (RANSAC, Fischler and Bolles 1981), refined by its points."""
    if len(points) < _FEWEST:
        return None
    a, b, c = (points[rng.integers(len(points), size=_TRIALS)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-9] / length[length > 1e-9][:, None]
    offsets = np.einsum("tc,tc->t", normals, a[length > 1e-9])
    if not len(normals):
        return None
    on = np.abs(points @ normals.T - offsets) <= _ON_PLANE * points[:, 2:]
    best = on[:, int(on.sum(axis=0).argmax())]
    middle = points[best].mean(axis=0)
    normal = np.linalg.svd(points[best] - middle, full_matrices=False)[2][2]
    return normal, float(normal @ middle)


def _points(frame: Frame, pixels: Mask) -> Array:
    """(P, 3): the measured points of pixels (H, W), camera frame."""
    return frame.camera.rays(np.stack(np.nonzero(pixels)[::-1], axis=1) + 0.5) * frame.depth[pixels][:, None]


def _largest(depth: NDArray[np.float32], measured: Mask, seed: tuple[float, float] | None, clicked: bool) -> Mask:
    """The connected surface with most pixels; with a seed, those near it count for more, or it alone is ``clicked``."""
    labels, count = _surfaces(depth, measured)
    rows, columns = np.nonzero(measured)
    if not len(rows):
        return measured
    weight = np.ones(len(rows))
    if seed is not None:
        apart = np.hypot(rows - seed[0], columns - seed[1])
        if clicked:
            return _of(int(labels[apart.argmin()]), labels, measured)
        spread = 0.25 * max(np.ptp(rows), np.ptp(columns), 1)
        weight = np.exp(-0.5 * (apart / spread) ** 2)
    sizes = np.bincount(labels, weight, minlength=count)
    best = int(sizes.argmax())
    chosen = _of(best, labels, measured)
    # Something thin before it may part the thing: pieces at its depth belong to it.
    low, high = np.quantile(depth[chosen], [0.05, 0.95])
    reach = max(high - low, _JUMP * high)
    for other in np.flatnonzero(np.bincount(labels, minlength=count) >= _FEWEST):
        if other != best:
            piece = _of(int(other), labels, measured)
            if low - reach <= np.median(depth[piece]) <= high + reach:
                chosen |= piece
    return chosen


def _of(label: int, labels: NDArray[Any], measured: Mask) -> Mask:
    out = np.zeros_like(measured)
    out[measured] = labels == label
    return out


def _surfaces(depth: NDArray[np.float32], measured: Mask) -> tuple[NDArray[np.int64], int]:
    """The number of the connected surface of each measured pixel, row by row, and how many there are."""
    number = np.full(measured.shape, -1)
    number[measured] = np.arange(int(measured.sum()))
    first, second = (np.concatenate(parts) for parts in zip(*_links(depth, number), strict=True))
    total = int(measured.sum())
    graph = sparse.coo_array((np.ones(len(first), np.bool_), (first, second)), shape=(total, total))
    count, labels = csgraph.connected_components(graph, directed=False)
    return labels.astype(np.int64), int(count)


def _links(
    depth: NDArray[np.float32], number: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    for here, there in (
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
    ):
        near = np.abs(depth[here] - depth[there]) <= _JUMP * np.minimum(depth[here], depth[there])
        both = (number[here] >= 0) & (number[there] >= 0) & near
        yield number[here][both], number[there][both]


def read_json_detections(path: Path, index: int | None = None) -> tuple[ImageDetection, ...]:
    """Those of a file; masks that it names lie beside it. Raises InvalidDetectionError."""
    try:
        values = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise InvalidDetectionError(f"{path.name} is not JSON: {error}") from error
    return read_image_detections(values, path.parent, index)
