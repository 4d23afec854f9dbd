"""How steeply each pixel's ray meets the surface, and how noisy its depth is, from the depths around it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_REACH = 2
"""Pixels on either side: a window of 5 x 5 is wide enough to average a sensor's noise."""
_SAME_SURFACE = 0.04
"""Depths that differ by a larger share lie on different surfaces: on one seen at 60 degrees a pixel of a common camera
makes a hundredth."""
_MIN_PIXELS = 8
_STEEPEST = 0.1
_DEPTH_BINS = 20


@dataclass(frozen=True)
class LocalPlanes:
    """Of N images: cosines (N, H, W) between ray and surface normal, at least .1, 0 where no plane could be laid ·
    deviations: (N, H, W) standard deviation of a depth's noise, its own units."""

    cosines: NDArray[np.float32]
    deviations: NDArray[np.float32]


def local_planes(depths: NDArray[np.float32], intrinsics: Floats) -> LocalPlanes:
    """A plane for every pixel.

    depths: (N, H, W) · intrinsics: (N, 3, 3). On a plane 1/z is linear in the pixel's place, and the plane's normal
    follows from the slopes; they are fitted by least squares over a window, to depths close to the pixel's own: a thin
    leg keeps its own plane before the wall behind it. The noise at a depth is the median of what the planes at about
    that depth leave over.
    """
    cosines, left_over = np.zeros(depths.shape, np.float32), np.zeros(depths.shape, np.float32)
    for image, (depth, camera) in enumerate(zip(depths, intrinsics, strict=True)):
        cosines[image], left_over[image] = _of_one(depth, camera)
    return LocalPlanes(cosines, _by_depth(depths, left_over, cosines > 0.0))


def _by_depth(
    depths: NDArray[np.float32], left_over: NDArray[np.float32], known: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """The median of ``left_over`` (N, H, W) as a function of the depth, at every pixel."""
    if not known.any():
        return np.zeros_like(depths)
    z, noise = depths[known], left_over[known]
    edges = np.quantile(z, np.linspace(0.0, 1.0, _DEPTH_BINS + 1))
    bins = np.clip(np.searchsorted(edges, z, side="right") - 1, 0, _DEPTH_BINS - 1)
    filled = [i for i in range(_DEPTH_BINS) if (bins == i).any()]
    middles = [float(np.median(z[bins == i])) for i in filled]
    medians = [float(np.median(noise[bins == i])) for i in filled]
    return np.interp(depths, middles, medians).astype(np.float32)


def _of_one(depth: NDArray[np.float32], camera: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rows, columns = np.indices(depth.shape) + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera).T  # (H, W, 3)
    valid = depth > 0.0
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth, np.float64), where=valid)
    x, y = rays[..., 0], rays[..., 1]
    count, sums = _moments(x, y, inverse, valid)
    known = valid & (count >= _MIN_PIXELS)
    mx, my, mi, xx, yy, xy, xi, yi, ii = sums / np.where(known, count, 1.0)
    # all relative to the pixel itself, see _moments
    xx, yy, xy = xx - mx * mx, yy - my * my, xy - mx * my
    xi, yi, ii = xi - mx * mi, yi - my * mi, ii - mi * mi
    determinant = xx * yy - xy * xy
    known &= determinant > 1e-2 * (xx + yy) ** 2
    determinant = np.where(known, determinant, 1.0)
    a, b = (yy * xi - xy * yi) / determinant, (xx * yi - xy * xi) / determinant
    # 1/z = a x + b y + c: the plane's normal is (a, b, c), and its product with the ray (x, y, 1) is 1/z
    here = inverse + mi - a * mx - b * my
    normal = np.stack([a, b, here - a * x - b * y], axis=-1)
    cosine = here / np.maximum(np.linalg.norm(normal, axis=-1) * np.linalg.norm(rays, axis=-1), 1e-12)
    # three numbers were fitted to each window; a deviation of 1/z is one of z by z squared
    variance = np.maximum(ii - a * xi - b * yi, 0.0) * count / np.maximum(count - 3.0, 1.0)
    deviation = np.where(known, np.sqrt(variance) * depth.astype(np.float64) ** 2, 0.0)
    cosine = np.where(known, np.clip(cosine, _STEEPEST, 1.0), 0.0)
    return cosine.astype(np.float32), deviation.astype(np.float32)


def _moments(x: Floats, y: Floats, inverse: Floats, valid: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """How many pixels of each window lie on its middle's surface, (H, W), and sums over them, (9, H, W): of x, y and
    i = 1/z less the middle's, and of their products xx, yy, xy, xi, yi, ii."""
    height, width = inverse.shape
    count = np.zeros(inverse.shape)
    sums = np.zeros((9, *inverse.shape))
    for down, right in product(range(-_REACH, _REACH + 1), repeat=2):
        here = slice(max(0, -down), height - max(0, down)), slice(max(0, -right), width - max(0, right))
        there = slice(max(0, down), height - max(0, -down)), slice(max(0, right), width - max(0, -right))
        i = inverse[there] - inverse[here]
        same = valid[there] & (np.abs(i) < _SAME_SURFACE * inverse[here])
        dx, dy, i = (np.where(same, each, 0.0) for each in (x[there] - x[here], y[there] - y[here], i))
        count[(*here,)] += same
        for k, term in enumerate((dx, dy, i, dx * dx, dy * dy, dx * dy, dx * i, dy * i, i * i)):
            sums[(k, *here)] += term
    return count, sums
