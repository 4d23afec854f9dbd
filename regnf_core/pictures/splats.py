"""A small renderer for oriented points: each is drawn as a disc lying in its surface, with a depth buffer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_AMBIENT = 0.45
_STEEPEST = 0.12  # a disc seen at a grazing angle is drawn as if its normal leaned this much towards the viewer

_DEPTH_STEPS = 256.0  # steps of the depth buffer a pixel

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]


@dataclass(frozen=True)
class View:
    """An orthographic camera: rows right, up, back (3, 3), the centre (3,) shown mid-picture, and pixels a unit."""

    axes: Floats
    centre: Floats
    pixels_per_unit: float


@dataclass(frozen=True)
class Surfels:
    """Oriented coloured points: points, normals (N, 3) in one frame, colours (N, 3) within 0 and 1."""

    points: Floats
    normals: Floats
    colours: Floats

    @classmethod
    def join(cls, *parts: Surfels) -> Surfels:
        """All of them as one cloud."""
        return cls(
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.normals for part in parts]),
            np.concatenate([part.colours for part in parts]),
        )


def view_from(direction: Floats, up: Floats, points: Floats, size: int, fill: float = 0.86) -> View:
    """The view along -``direction`` in which all ``points`` (N, 3) fill that share of a ``size`` pixel square."""
    back = direction / np.linalg.norm(direction)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    seen = points @ axes.T
    low, high = seen.min(0), seen.max(0)
    extent = max(float((high - low)[:2].max()), 1e-9)
    return View(axes, ((low + high) / 2) @ axes, fill * size / extent)


def render(surfels: Surfels, view: View, size: int, radius: float, background: Floats) -> Floats:
    """A picture (size, size, 3) within 0 and 1. ``radius`` of the discs is in the points' unit.

    Discs turned away from the viewer are lit from behind as well, so that hollow shapes stay readable.
    """
    seen = ((surfels.points - view.centre) @ view.axes.T * view.pixels_per_unit).astype(np.float32)  # right, up, near
    normals = surfels.normals @ view.axes.T
    normals = np.where(normals[:, 2:] < 0, -normals, normals)
    nearest = _nearest_surfels(seen, normals.astype(np.float32), size, radius * view.pixels_per_unit)
    picture = np.broadcast_to(background, (size * size, 3)).copy()
    hit = nearest >= 0
    picture[hit] = (surfels.colours * _shade(normals)[:, None])[nearest[hit]]
    return picture.reshape(size, size, 3)


def _nearest_surfels(seen: Singles, normals: Singles, size: int, radius: float) -> NDArray[np.int64]:
    """(size * size,) index of the disc nearest to the viewer in each pixel, -1 where there is none.

    seen: (N, 3) centres, pixels from the middle · normals: (N, 3) towards the viewer · radius: pixels.
    Works through the discs' window row by row. A pixel keeps the largest of 64-bit keys with the depth in the upper and
    the index in the lower half, so that one maximum decides and no sorting is needed.
    """
    keys = np.full(size * size, -1, dtype=np.int64)
    column, row = seen[:, :1] + size / 2, size / 2 - seen[:, 1:2]
    slope = normals[:, :2] / np.maximum(normals[:, 2:], np.float32(_STEEPEST))
    floor = float(seen[:, 2].min()) - radius / _STEEPEST - 1.0
    reach = int(np.ceil(radius))
    x = np.floor(column).astype(np.int32) + np.arange(-reach, reach + 1, dtype=np.int32)  # (N, W) pixels
    dx = x + np.float32(0.5) - column
    for offset in range(-reach, reach + 1):
        y = np.floor(row).astype(np.int32) + offset  # (N, 1)
        dy = row - y - np.float32(0.5)
        dz = -(slope[:, :1] * dx + slope[:, 1:] * dy)
        inside = (dx * dx + dy * dy + dz * dz <= radius * radius) & (x >= 0) & (x < size) & (y >= 0) & (y < size)
        source = np.nonzero(inside)[0]
        depth = ((seen[:, 2:] + dz)[inside] - floor) * _DEPTH_STEPS
        pixel = (y * size + x)[inside]
        np.maximum.at(keys, pixel, (depth.astype(np.int64) << 32) | source)
    return np.where(keys >= 0, keys & 0xFFFFFFFF, -1)


def _shade(normals: Floats) -> Floats:
    """(N,) brightness under a lamp above the viewer's left shoulder."""
    lamp = np.array([-0.4, 0.65, 0.65])
    lamp /= np.linalg.norm(lamp)
    light: Floats = _AMBIENT + (1.0 - _AMBIENT) * np.clip(normals @ lamp, 0.0, 1.0)
    return light
