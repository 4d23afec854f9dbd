"""The depths that a camera sees of Gaussian splats: the middle of the layer that stops half of the light from behind.

Splats are projected to ellipses as in 3DGS (Kerbl et al. 2023), blurred by a pixel and dimmed by as much, so that small
ones keep their weight at any resolution (Mip-Splatting, Yu et al. 2024). A pixel's fragments are taken from near to
far, each with a depth on the plane in which its splat is widest. Where the transmittance falls below one half is the
layer's near side if splats lie in several sheets: the depth is the mean of the fragments close to it, by opacity.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from regnf_core.importing.splats.gaussians import Doubles, Floats, Splats
from regnf_core.native.library import Variant, variant

_BLUR = 0.3
"""Variance of a pixel's filter, pixels squared, as in 3DGS."""
_LEAST = 1.0 / 64.0
"""Fragments with less opacity are left out."""
_OPAQUE = 0.99
_HALF = float(np.log(0.5))
_REACH = 3.0
"""Standard deviations of the weights within which fragments count."""
_EDGE_ON = 0.01
"""Of a splat's extent in the image, squared: a thin one that is seen from its edge has no steeper plane."""
_FRAGMENTS = 1 << 21
"""So many at once: memory."""
_NEAREST = 0.01
"""Splats nearer than this share of the farthest are not drawn: their ellipses would fill the image."""
_WIDEST = 1.3
"""Centers beyond so many half images are not drawn: the projection is linear near its middle only."""
MOST_PIXELS = 1 << 16
"""Of an image: a pixel's number has 16 bits."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """What does not depend on the camera. means: (N, 3) · factors: (N, 3, 3), own axes times standard deviations."""

    means: Floats
    factors: Floats
    opacities: Floats
    colors: Floats


def prepared(splats: Splats) -> Prepared:
    """float32, about 64 bytes a splat."""
    factors = splats.axes() * np.exp(splats.scales)[:, None, :]
    return Prepared(splats.means.astype(np.float32), factors.astype(np.float32), splats.opacities, splats.colors)


@dataclass(frozen=True, eq=False)
class Camera:
    """T_camera_world: (4, 4), OpenCV's axes · focal, middle: pixels, x and y · size: width and height."""

    T_camera_world: Doubles
    focal: tuple[float, float]
    middle: tuple[float, float]
    size: tuple[int, int]

    @property
    def matrix(self) -> Doubles:
        """(3, 3): intrinsics."""
        (fx, fy), (cx, cy) = self.focal, self.middle
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def depth_image(splats: Prepared, camera: Camera, layer: float) -> tuple[Floats, npt.NDArray[np.uint8]]:
    """(H, W) depths along the camera's axis, 0 where less than half of the light is stopped; (H, W, 3) colors.

    layer: standard deviation of the weights of fragments around where half is stopped, the unit of the depths.
    """
    width, height = camera.size
    seen = _projected(splats, camera)
    compiled = variant()
    if compiled is not None:
        return _compiled(compiled, seen, width, height, layer)
    images = _Images(width, height, layer)
    counts = (seen.high - seen.low).prod(axis=1)
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        end = max(start + 1, int(np.searchsorted(ends, (ends[start - 1] if start else 0) + _FRAGMENTS, "right")))
        images.close(float(seen.depth[start]))
        if images.done.all():
            break
        part = _still_seen(seen.chosen(slice(start, end)), images.done)
        start = end
        if len(part.depth):
            images.blend(part)
    return images.finished()


def _compiled(
    compiled: Variant, seen: _Ellipses, width: int, height: int, layer: float
) -> tuple[Floats, npt.NDArray[np.uint8]]:
    """The same by compiled code, in a tenth of the time."""
    parts = (seen.center, seen.conic, seen.depth[:, None], seen.slope, seen.opacity[:, None], seen.color)
    ellipses = np.ascontiguousarray(np.concatenate(parts, axis=1), np.float32)
    boxes = np.stack([seen.low[:, 0], seen.high[:, 0], seen.low[:, 1], seen.high[:, 1]], axis=1).astype(np.int32)
    work, depths = np.zeros((height, width, 4), np.float32), np.zeros((height, width), np.float32)
    colors = np.zeros((height, width, 3), np.float32)
    given, made = (ellipses.ctypes.data, boxes.ctypes.data), (work.ctypes.data, depths.ctypes.data, colors.ctypes.data)
    compiled.steps.gaussian_depths(*given, len(ellipses), width, height, layer, *made)
    return depths, (255.0 * colors).clip(0, 255).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class _Ellipses:
    """From near to far. center, low, high: (M, 2), pixels; the last two the box that is drawn · conic: (M, 3), the
    inverse covariance's xx, xy, yy · slope: (M, 2), of the depth, a pixel."""

    center: Floats
    low: npt.NDArray[np.int32]
    high: npt.NDArray[np.int32]
    conic: Floats
    depth: Floats
    slope: Floats
    opacity: Floats
    color: Floats

    def chosen(self, which: slice | npt.NDArray[np.bool_]) -> _Ellipses:
        """Those of a mask or a slice."""
        return _Ellipses(**{each.name: getattr(self, each.name)[which] for each in fields(self)})


def _projected(splats: Prepared, camera: Camera) -> _Ellipses:
    turn = camera.T_camera_world[:3, :3].astype(np.float32)
    places = splats.means @ turn.T + camera.T_camera_world[:3, 3].astype(np.float32)
    z = places[:, 2]
    focal, middle = np.array(camera.focal, np.float32), np.array(camera.middle, np.float32)
    size = np.array(camera.size, np.float32)
    near = _NEAREST * float(z.max(initial=0.0))
    with np.errstate(all="ignore"):
        center = places[:, :2] / z[:, None] * focal + middle
        inside = (z > max(near, 1e-9)) & (np.abs(center - size / 2) < _WIDEST * size / 2).all(axis=1)
    kept = np.flatnonzero(inside)
    kept = kept[np.argsort(z[kept], kind="stable")]
    places, center = places[kept], center[kept]
    z = places[:, 2:3]
    own = turn @ splats.factors[kept]  # (M, 3, 3): the camera's axes as rows
    ratio = places[:, :2] / z
    rows = (own[:, :2] - ratio[:, :, None] * own[:, 2:3]) * (focal / z)[:, :, None]
    xx, xy, yy = (rows[:, 0] ** 2).sum(1), (rows[:, 0] * rows[:, 1]).sum(1), (rows[:, 1] ** 2).sum(1)
    along = (rows * own[:, 2:3]).sum(axis=2)  # covariance of depth and pixel
    slope = _solved(xx, xy, yy, np.float32(_EDGE_ON) * (xx + yy), along)
    plain = np.maximum(xx * yy - xy * xy, 0.0)
    xx, yy = xx + np.float32(_BLUR), yy + np.float32(_BLUR)
    area = xx * yy - xy * xy
    opacity = splats.opacities[kept] * np.sqrt(plain / area)
    conic = np.stack([yy, -xy, xx], axis=1) / area[:, None]
    reach = np.sqrt(2.0 * np.log(np.maximum(opacity / _LEAST, 1.0)))
    extent = reach[:, None] * np.sqrt(np.stack([xx, yy], axis=1))
    low = np.clip(np.ceil(center - extent - 0.5), 0, size).astype(np.int32)
    high = np.clip(np.floor(center + extent - 0.5) + 1, 0, size).astype(np.int32)
    found = _Ellipses(center, low, high, conic, z[:, 0], slope, opacity, splats.colors[kept])
    return found.chosen((high > low).all(axis=1) & (opacity > _LEAST))


def _solved(xx: Floats, xy: Floats, yy: Floats, more: Floats, right: Floats) -> Floats:
    """(M, 2): solutions of the symmetric systems [[xx + more, xy], [xy, yy + more]] x = right."""
    xx, yy = xx + more, yy + more
    area = np.maximum(xx * yy - xy * xy, np.float32(1e-30))
    x, y = right.T
    solved: Floats = (np.stack([yy * x - xy * y, xx * y - xy * x], axis=1) / area[:, None]).astype(np.float32)
    return solved


def _still_seen(part: _Ellipses, done: npt.NDArray[np.bool_]) -> _Ellipses:
    """Those whose boxes have a pixel that is not done, by a table of sums."""
    sums = np.zeros((done.shape[0] + 1, done.shape[1] + 1), np.int32)
    sums[1:, 1:] = (~done).cumsum(axis=0, dtype=np.int32).cumsum(axis=1, dtype=np.int32)
    (x, y), (right, below) = part.low.T, part.high.T
    left = sums[below, right] - sums[y, right] - sums[below, x] + sums[y, x]
    return part.chosen(left > 0)


class _Images:
    """What the fragments that were taken so far make of each pixel."""

    def __init__(self, width: int, height: int, layer: float) -> None:
        pixels = width * height
        self.done = np.zeros((height, width), np.bool_)
        self._layer = np.float32(layer)
        self._light = np.zeros(pixels)  # logarithm of the transmittance
        self._half = np.zeros(pixels, np.float32)
        self._color, self._weight = np.zeros((pixels, 3), np.float32), np.zeros(pixels, np.float32)
        self._taken: list[tuple[npt.NDArray[np.uint16], Floats, Floats]] = []

    def close(self, depth: float) -> None:
        """What comes is not nearer than ``depth``: pixels whose layer ends before are done."""
        reached = (self._light < _HALF) & (self._half + _REACH * self._layer < depth)
        self.done |= reached.reshape(self.done.shape)

    def blend(self, part: _Ellipses) -> None:
        """Take the fragments of ellipses, which lie behind all that were taken before."""
        owner, pixel, depth, alpha = _fragments(part, self.done)
        if not len(pixel):
            return
        light = self._light
        first = np.flatnonzero(np.diff(pixel.astype(np.int32), prepend=-1))
        lengths = np.diff(first, append=len(pixel))
        fallen = np.cumsum(np.log1p(-alpha.astype(np.float64)))
        before = np.repeat(np.concatenate([[0.0], fallen[first[1:] - 1]]), lengths)
        behind = fallen - before + light[pixel]  # after each fragment
        ahead = np.concatenate([[0.0], behind[:-1]])
        ahead[first] = light[pixel[first]]
        counted = ahead >= _HALF
        crossed = np.flatnonzero(counted & (behind < _HALF))
        self._half[pixel[crossed]] = depth[crossed]
        share = np.where(counted, np.exp(ahead) * alpha, 0.0).astype(np.float32)
        self._weight += np.bincount(pixel, share, len(light)).astype(np.float32)
        for channel in range(3):
            color = share * part.color[owner, channel]
            self._color[:, channel] += np.bincount(pixel, color, len(light)).astype(np.float32)
        light[pixel[first]] = behind[first + lengths - 1]
        self._taken.append((pixel, depth, alpha))

    def finished(self) -> tuple[Floats, npt.NDArray[np.uint8]]:
        """Depths and colors."""
        told = self._light < _HALF
        sums, weights = np.zeros(len(told)), np.zeros(len(told))
        for pixel, depth, alpha in self._taken:
            off = (depth - self._half[pixel]) / self._layer
            near = np.flatnonzero(np.abs(off) < _REACH)
            weight = alpha[near] * np.exp(-0.5 * off[near] ** 2)
            sums += np.bincount(pixel[near], weight * depth[near], len(told))
            weights += np.bincount(pixel[near], weight, len(told))
        with np.errstate(all="ignore"):
            depths = np.where(told, sums / weights, 0.0).astype(np.float32)
            levels = np.nan_to_num(255.0 * self._color / self._weight[:, None])
        shape = self.done.shape
        return depths.reshape(shape), levels.clip(0, 255).astype(np.uint8).reshape(*shape, 3)


def _fragments(
    part: _Ellipses, done: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.uint16], Floats, Floats]:
    """Of ellipses at pixels that are not done: the ellipse, the pixel, depth and opacity, (F,) each, ordered by pixel
    and within a pixel from near to far."""
    widths = part.high[:, 0] - part.low[:, 0]
    counts = widths * (part.high[:, 1] - part.low[:, 1])
    owner = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    number = np.arange(len(owner), dtype=np.int32) - np.repeat(np.cumsum(counts, dtype=np.int32) - counts, counts)
    row, column = np.divmod(number, widths[owner])
    row, column = row + part.low[owner, 1], column + part.low[owner, 0]
    open_ = ~done[row, column]
    owner, row, column = owner[open_], row[open_], column[open_]
    dx = column + np.float32(0.5) - part.center[owner, 0]
    dy = row + np.float32(0.5) - part.center[owner, 1]
    conic = part.conic[owner]
    fall = conic[:, 0] * dx * dx + 2.0 * conic[:, 1] * dx * dy + conic[:, 2] * dy * dy
    alpha = np.minimum(part.opacity[owner] * np.exp(-0.5 * fall), np.float32(_OPAQUE))
    kept = np.flatnonzero(alpha > _LEAST)
    pixel = (row * done.shape[1] + column)[kept].astype(np.uint16)
    order = np.argsort(pixel, kind="stable")  # by radix, as the numbers have 16 bits
    kept, pixel = kept[order], pixel[order]
    owner = owner[kept]
    own = part.depth[owner]
    depth = own + part.slope[owner, 0] * dx[kept] + part.slope[owner, 1] * dy[kept]
    return owner, pixel, np.maximum(depth, 0.5 * own), alpha[kept]
