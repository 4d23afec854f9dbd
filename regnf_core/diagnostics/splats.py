"""A small renderer for oriented points: each is drawn as a disc lying in its surface, with a depth buffer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_AMBIENT = 0.45
_STEEPEST = 0.12  # a disc seen at a grazing angle is drawn as if its normal leaned this much towards the viewer

Floats = NDArray[np.float64]


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
    seen = (surfels.points - view.centre) @ view.axes.T * view.pixels_per_unit  # x right, y up, z towards the viewer
    normals = surfels.normals @ view.axes.T
    normals = np.where(normals[:, 2:] < 0, -normals, normals)
    reach = int(np.ceil(radius * view.pixels_per_unit))
    window = np.stack(np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)), -1).reshape(
        -1, 2
    )  # (W, 2)
    column, row = seen[:, 0] + size / 2, size / 2 - seen[:, 1]
    x = np.floor(column)[:, None] + window[None, :, 0]  # (N, W) pixels
    y = np.floor(row)[:, None] + window[None, :, 1]
    dx, dy = x + 0.5 - column[:, None], -(y + 0.5 - row[:, None])
    steep = np.maximum(normals[:, 2:], _STEEPEST)
    dz = -(normals[:, :1] * dx + normals[:, 1:2] * dy) / steep
    inside = (
        (dx**2 + dy**2 + dz**2 <= (radius * view.pixels_per_unit) ** 2) & (x >= 0) & (x < size) & (y >= 0) & (y < size)
    )
    source, _ = np.nonzero(inside)
    depth = (seen[:, 2:] + dz)[inside]
    order = np.argsort(depth, kind="stable")  # far to near: the nearest is written last
    pixel = (y[inside] * size + x[inside]).astype(np.int64)[order]
    picture = np.broadcast_to(background, (size * size, 3)).copy()
    picture[pixel] = (surfels.colours * _shade(normals)[:, None])[source[order]]
    return picture.reshape(size, size, 3)


def _shade(normals: Floats) -> Floats:
    """(N,) brightness under a lamp above the viewer's left shoulder."""
    lamp = np.array([-0.4, 0.65, 0.65])
    lamp /= np.linalg.norm(lamp)
    light: Floats = _AMBIENT + (1.0 - _AMBIENT) * np.clip(normals @ lamp, 0.0, 1.0)
    return light
