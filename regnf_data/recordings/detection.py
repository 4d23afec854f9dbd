"""Detections in images, lifted to boxes in space."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy import ndimage

from regnf_core.detections.images import HINT, ImageDetection
from regnf_core.errors import InvalidDetectionError
from regnf_core.geometry.box import OrientedBox
from regnf_data.recordings.camera import Array, Size
from regnf_data.recordings.recording import MOST_PIXELS, Frame

Mask = NDArray[np.bool_]


_MASK_FORMATS, _HALF = ("PNG", "JPEG", "BMP"), 127


def mask_of(value: Any, size: Size | None = None) -> Mask:
    """(H, W): of an array, an image as base64, COCO's run lengths or polygons. size: height and width, for polygons.

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
    if isinstance(value, str) and len(value) > 64:
        try:
            data = base64.b64decode(value.partition("base64,")[2] or value, validate=True)
            with Image.open(io.BytesIO(data), formats=_MASK_FORMATS) as image:
                if image.width * image.height <= MOST_PIXELS:
                    return _of_picture(image)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            known = ", ".join(_MASK_FORMATS)
            raise InvalidDetectionError(f"the mask is not a base64 image of these types: {known}") from error
    said = f"the mask is not a file, not a base64 image and not a run-length encoding of COCO: {str(value)[:80]!r}"
    raise InvalidDetectionError(said, hint=HINT)


def _of_picture(image: Image.Image) -> Mask:
    """True where a picture is not black; where it is opaque, if not all of it is; of one with a palette without black,
    where it has not the first color; of shades, as of probabilities, where it is brighter than half."""
    if "A" in image.getbands() and np.ptp(alpha := np.asarray(image.getchannel("A"))):
        return np.asarray(alpha > _HALF)
    gray = np.asarray(image.convert("L"))
    if image.mode == "P" and gray.min() > 0:
        return np.asarray(image) > 0
    return np.asarray(gray > (_HALF if gray.min() > 0 and np.ptp(gray) > 0 else 0))


def _run_lengths(value: Mapping[str, Any]) -> Mask:
    """COCO's: lengths of runs of 0 and 1 in turn, down the columns; as numbers or as text of five bits each."""
    try:
        height, width = (int(side) for side in value["size"])
        counts = value["counts"]
        lengths = _text_lengths(counts) if isinstance(counts, str) else [int(count) for count in counts]
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InvalidDetectionError(f"the mask's run-length encoding cannot be read: {error}") from error
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
    if polygons and isinstance(polygons[0], int | float):
        polygons = [polygons]
    try:
        flat = [[float(number) for number in polygon] for polygon in polygons]
        if len(flat) > 2 and {len(polygon) for polygon in flat} == {2}:  # one polygon, of pairs
            flat = [[number for pair in flat for number in pair]]
        reach = max(max(polygon) for polygon in flat)
        if {number for polygon in flat for number in polygon} <= {0.0, 1.0}:  # rows of a mask
            return np.array(flat) > 0.0
        if reach <= 1.0 and size:  # shares of the image's sides
            flat = [[number * size[1 - at % 2] for at, number in enumerate(polygon)] for polygon in flat]
        height, width = (int(side) for side in size) if size else (int(reach) + 2, int(reach) + 2)
    except (TypeError, ValueError) as error:
        raise InvalidDetectionError("the polygons of the mask are not lists x, y, x, y ...", hint=HINT) from error
    if any(len(polygon) < 6 or len(polygon) % 2 for polygon in flat) or not 0 < height * width <= MOST_PIXELS:
        raise InvalidDetectionError("a polygon of a mask needs at least three corners", hint=HINT)
    image = Image.new("1", (width, height))
    for polygon in flat:
        ImageDraw.Draw(image).polygon(polygon, fill=1)
    return np.asarray(image)


# Lifting.

_FEWEST = 30
"""Measured pixels of an object, at least."""
_JUMP = 0.015
"""A share of the depth: neighbors that differ by more lie on different surfaces."""
_AROUND, _EDGE = 0.5, 8
"""Of the sides of what is detected, and pixels: how far around it is looked, and how far outlines are off."""
_TRIALS, _SAMPLES, _PLANES = 100, 1500, 4
_ON_PLANE, _LEAST_ON_PLANE = 0.008, 0.0025
"""Shares of the depth: what lies nearer to a plane of the background belongs to it, by the sensor's noise between."""
_PLANE_SHARE = 0.15
"""Of the pixels around, to be a plane of the background."""
_WHOLE, _MOSTLY = 0.9, 0.5
"""Shares of a surface within the detection: it ends there; it belongs to what is detected."""
_LONGER = 1.2
"""Diameters of the object: a surface that is longer is not its own."""
_BEHIND = 0.2
"""Of what is in the middle of a detection, behind a plane of its background, at most."""
_TRIMMED = 0.01
_LOOSE = 0.1
"""Of the box's size, on each side together: what a detector's mask cuts off, and the sensor's noise."""


@dataclass(frozen=True, eq=False)
class Lifted:
    """box: around the object, in the world · points: (P, 3), of its surface, world · pixels: (H, W) of the depth image,
    those of the object · frame: in which."""

    box: OrientedBox
    points: Array
    pixels: Mask
    frame: Frame


@dataclass(frozen=True, eq=False)
class _Part:
    """Of an image, around a detection, (h, w) pixels. depth: 0 for none · points: (h, w, 3), camera frame · inside:
    what is detected · seed: the pixel (row, column) that it points at · clicked: whether that one is the object's ·
    diameter: the object's, m."""

    depth: NDArray[np.float32]
    points: Array
    inside: Mask
    seed: tuple[float, float] | None
    clicked: bool
    diameter: float


def lift(frame: Frame, detection: ImageDetection, diameter: float | None = None) -> Lifted:
    """The instance of a detection, in space. diameter: of the known object, m, where its size is known.

    The depth in a mask, in a box or around a point falls into connected surfaces, without the planes that go on around
    it (a table, a wall). The instance is the surface that fills most of the detection and does not go on beyond it:
    where it ends a few pixels beyond an outline, the outline is taken to be off. Its box has the camera's axes; behind,
    it reaches as far as the instance is wide, since its back was not seen.
    Raises InvalidDetectionError, naming the frame, for detections without depth or of another size than the image.
    """
    region, seed = _region(frame, detection)
    measured = region & (frame.depth > 0.0)
    if measured.sum() < _FEWEST:
        raise _without_depth(frame, f"{int(measured.sum())} of {int(region.sum())} pixels of the detection")
    clicked = detection.point_2d is not None
    if clicked and seed is not None and diameter is not None:
        # Nothing of an object that was clicked on is farther from the click than its diameter.
        here = _points(frame, measured)
        rows, columns = np.nonzero(measured)
        middle = here[np.hypot(rows - seed[0], columns - seed[1]).argmin()]
        region = np.zeros_like(region)
        region[rows, columns] = np.linalg.norm(here - middle, axis=1) <= diameter
    window = _window(region)
    shown = np.zeros_like(region)
    shown[window] = frame.depth[window] > 0.0
    points = np.zeros((*region[window].shape, 3))
    points[shown[window]] = _points(frame, shown)
    moved = None if seed is None else (seed[0] - window[0].start, seed[1] - window[1].start)
    pixels = np.zeros_like(region)
    pixels[window] = _thing(_Part(frame.depth[window], points, region[window], moved, clicked, diameter or np.inf))
    camera_points = points[pixels[window]]
    if diameter is not None and len(camera_points):
        # Nothing of the object is farther from its middle than its diameter.
        near = np.linalg.norm(camera_points - np.median(camera_points, axis=0), axis=1) <= diameter
        pixels[pixels] = near
        camera_points = camera_points[near]
    if len(camera_points) < _FEWEST:
        raise _without_depth(frame, f"{len(camera_points)} of the object's pixels")
    low, high = (np.quantile(camera_points, share, axis=0) for share in (_TRIMMED, 1.0 - _TRIMMED))
    behind = max(float((high - low)[:2].max()), diameter or 0.0)
    high[2] = max(high[2], low[2] + behind)
    size = (high - low) * (1.0 + _LOOSE)
    R, t = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3]
    center, axes = torch.from_numpy(R @ ((low + high) / 2.0) + t), torch.from_numpy(R.copy())
    box = OrientedBox(center, torch.from_numpy(size), axes, detection.label, detection.score)
    return Lifted(box, camera_points @ R.T + t, pixels, frame)


def _without_depth(frame: Frame, said: str) -> InvalidDetectionError:
    said = f"frame {frame.name}: depth was measured in {said}; at least {_FEWEST} are required"
    return InvalidDetectionError(said, reason="DETECTION_WITHOUT_DEPTH")


def _region(frame: Frame, detection: ImageDetection) -> tuple[Mask, tuple[float, float] | None]:
    """(H, W) of the depth image: the pixels that the detection is about, and the pixel (row, column) it points at."""
    given: Size = frame.depth.shape if frame.color is None else frame.color.shape[:2]
    height, width = given
    mask, seed = None, None
    if detection.mask is not None:
        mask = mask_of(detection.mask, detection.size or given)
        if mask.shape not in (given, frame.depth.shape):
            if abs(mask.shape[0] * width - mask.shape[1] * height) > max(*mask.shape, width, height):
                raise InvalidDetectionError(
                    f"frame {frame.name}: the mask has {mask.shape[1]} x {mask.shape[0]} pixels, not {width} x {height}"
                )
            rows, columns = (np.arange(b) * a // b for a, b in zip(mask.shape, given, strict=True))
            mask = mask[rows[:, None], columns]  # detectors work on smaller images
        if not mask.any():
            raise InvalidDetectionError(f"frame {frame.name}: the mask is empty")
        if not mask.all() and mask[[0, -1]].all() and mask[:, [0, -1]].all():
            raise InvalidDetectionError(
                f"frame {frame.name}: the mask is true along the whole border. Check whether it is inverted."
            )
        return frame.registered(mask), None
    mask = np.zeros(given, dtype=np.bool_)
    if detection.box_2d is not None:
        left, top, right, bottom = detection.box_2d
        if max(right, bottom) <= 1.0:  # shares of the image's sides
            left, top, right, bottom = left * width, top * height, right * width, bottom * height
        columns, rows = (np.clip([a, b], 0, side) for a, b, side in ((left, right, width), (top, bottom, height)))
        mask[int(rows[0]) : int(np.ceil(rows[1])), int(columns[0]) : int(np.ceil(columns[1]))] = True
        if not mask.any():
            raise InvalidDetectionError(f"frame {frame.name}: the box is outside the image, {width} x {height}")
        middle = ((rows[0] + rows[1]) / 2.0, (columns[0] + columns[1]) / 2.0)
    else:
        assert detection.point_2d is not None
        u, v = detection.point_2d
        if not (0 <= u < width and 0 <= v < height):
            raise InvalidDetectionError(
                f"frame {frame.name}: the point ({u:g}, {v:g}) is outside the image of {width} x {height} pixels"
            )
        mask[:] = True
        middle = (v, u)
    point = np.zeros(given, dtype=np.bool_)
    point[int(min(middle[0], height - 1)), int(min(middle[1], width - 1))] = True
    rows, columns = np.nonzero(frame.registered(ndimage.binary_dilation(point, iterations=2)))
    if len(rows):
        seed = (float(rows.mean()), float(columns.mean()))
    return frame.registered(mask), seed


def _window(region: Mask) -> tuple[slice, slice]:
    """Rows and columns of the pixels of a region, and around it."""
    spans = []
    for axis, side in enumerate(region.shape):
        held = np.flatnonzero(region.any(axis=1 - axis))
        low, high = int(held[0]), int(held[-1]) + 1
        more = max(int(_AROUND * (high - low)), 2 * _EDGE)
        spans.append(slice(max(low - more, 0), min(high + more, side)))
    return spans[0], spans[1]


def _thing(part: _Part) -> Mask:
    """(h, w): the pixels of the object."""
    measured = part.depth > 0.0
    kept = measured & ~_background(part)
    if (kept & part.inside).sum() < _FEWEST:
        kept = measured
    labels, count = _surfaces(part.depth, kept)
    rows, columns = np.nonzero(kept)
    inside = part.inside[kept]
    weight = inside.astype(np.float64)
    if part.seed is not None:
        apart = np.hypot(rows - part.seed[0], columns - part.seed[1])
        if part.clicked:
            weight *= labels == labels[np.where(inside, apart, np.inf).argmin()]
        else:
            sides = np.ptp(np.nonzero(part.inside), axis=1).max()
            weight *= np.exp(-0.5 * (apart / (0.25 * max(sides, 1))) ** 2)
    total, held = (np.bincount(labels, each, minlength=count) for each in (None, inside))
    share = held / np.maximum(total, 1)
    best = int((np.bincount(labels, weight, minlength=count) * share**2).argmax())
    # Something thin before it may part the object: pieces at its depth belong to it.
    depths = part.depth[kept]
    low, high = np.quantile(depths[labels == best], [0.05, 0.95])
    reach = max(high - low, _JUMP * high)
    middle = np.bincount(labels, depths, minlength=count) / np.maximum(total, 1)
    whole = _MOSTLY if part.seed is None else _WHOLE
    belongs = (held >= _FEWEST) & (share >= whole) & (low - reach <= middle) & (middle <= high + reach)
    if part.seed is not None:
        near = np.zeros_like(kept)
        near[kept] = labels == best
        near = ndimage.binary_dilation(near, iterations=2 * _EDGE)
        belongs &= (np.bincount(labels, near[kept], minlength=count) > 0) & (not part.clicked)
    belongs[best] = True
    around = ndimage.binary_dilation(part.inside, iterations=_EDGE)
    ends = np.bincount(labels, around[kept], minlength=count) >= _WHOLE * total
    out = np.zeros_like(kept)
    out[kept] = belongs[labels] & (inside | (ends[labels] & around[kept]))
    return out


def _background(part: _Part) -> Mask:
    """(h, w): what lies on planes that hold much of the surroundings, go on beyond the detection, and lie behind what
    is in its middle: those of a neighbor's faces cut through it."""
    measured = part.depth > 0.0
    out = np.zeros_like(measured)
    everything = bool(part.inside.all())
    around = measured & (~part.inside | part.clicked)
    if around.sum() < 3 * _FEWEST:
        return out
    own = _middle(part, measured & part.inside)
    rng = np.random.default_rng(0)
    left = part.points[around]
    left = left[rng.permutation(len(left))[:_SAMPLES]]
    total = len(left)
    for _ in range(_PLANES):
        plane = _plane(left, rng)
        if plane is None:
            break
        normal, offset = plane
        off = np.abs(left @ normal - offset) / left[:, 2]
        on = off <= _ON_PLANE
        if on.sum() < _PLANE_SHARE * total:
            break
        within = np.clip(4.5 * np.median(off[on]), _LEAST_ON_PLANE, _ON_PLANE)
        before = (offset - part.points @ normal) * (np.sign(offset) or 1.0)  # the camera's side counts positive
        there = measured & (np.abs(before) <= within * part.depth)
        behind = own & (before < -within * part.depth)
        goes_on = everything or _extent(part.points[there & part.inside]) > _LONGER * part.diameter
        goes_on |= bool((there & part.inside).sum() < _MOSTLY * there.sum())
        itself = (part.seed is None or everything) and (there & own).sum() > _MOSTLY * own.sum()
        if goes_on and not itself and behind.sum() <= _BEHIND * (own & ~there).sum():
            out |= there
        left = left[~on]
    return out


def _extent(points: Array) -> float:
    """The diagonal of points (P, 3), without the outermost ones; 0 for none."""
    if not len(points):
        return 0.0
    return float(np.linalg.norm(np.subtract(*(np.quantile(points, share, axis=0) for share in (0.98, 0.02)))))


def _middle(part: _Part, own: Mask) -> Mask:
    """Of the measured pixels ``own`` of a detection, those that are surely the object's, or nearly so."""
    if part.seed is None:
        core = own & (ndimage.distance_transform_edt(part.inside) > _EDGE)
        return core if core.sum() >= _FEWEST else own
    rows, columns = np.nonzero(own)
    apart = np.hypot(rows - part.seed[0], columns - part.seed[1])
    most = _FEWEST if part.clicked else max(_FEWEST, len(rows) // 4)
    nearest = apart.argsort()[:most]
    out = np.zeros_like(own)
    out[rows[nearest], columns[nearest]] = True
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
    middles = np.stack(np.nonzero(pixels)[::-1], axis=1).astype(np.float64) + 0.5
    return frame.camera.rays(middles) * frame.depth[pixels][:, None]


def _surfaces(depth: NDArray[np.float32], measured: Mask) -> tuple[NDArray[np.int64], int]:
    """The number of the connected surface of each measured pixel, row by row, and how many there are."""
    height, width = measured.shape
    linked = np.zeros((2 * height - 1, 2 * width - 1), np.bool_)  # pixels, and between them whether they are linked
    linked[::2, ::2] = measured
    for between, here, there in (
        (linked[1::2, ::2], np.s_[:-1], np.s_[1:]),
        (linked[::2, 1::2], np.s_[:, :-1], np.s_[:, 1:]),
    ):
        near = np.abs(depth[here] - depth[there]) <= _JUMP * np.minimum(depth[here], depth[there])
        between[:] = measured[here] & measured[there] & near
    labels, count = ndimage.label(linked)
    return labels[::2, ::2][measured].astype(np.int64) - 1, int(count)
