"""How steeply each pixel's ray meets the surface, from the depths around it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats = NDArray[np.float64]

_WINDOW = 5
"""Pixels along an edge of the window that a plane is laid through: wide enough to average a sensor's noise."""
_LEAST_SHARE = 0.5
_STEEPEST = 0.1


def ray_cosines(depths: NDArray[np.float32], intrinsics: Floats) -> NDArray[np.float32]:
    """(N, H, W): cosine between ray and surface normal, at least .1; 0 where no plane could be laid.

    depths: (N, H, W) · intrinsics: (N, 3, 3). On a plane 1/z is linear in the pixel's place, and the plane's normal
    follows from the slopes; they are fitted by least squares over a window, its own depths only.
    """
    cosines = np.zeros(depths.shape, np.float32)
    for image, (depth, camera) in enumerate(zip(depths, intrinsics, strict=True)):
        cosines[image] = _of_one(depth.astype(np.float64), camera)
    return cosines


def _of_one(depth: Floats, camera: Floats) -> NDArray[np.float32]:
    rows, columns = np.indices(depth.shape) + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera).T  # (H, W, 3)
    valid = depth > 0.0
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=valid)

    def mean(values: Floats) -> Floats:
        averaged: Floats = ndimage.uniform_filter(np.where(valid, values, 0.0), _WINDOW, mode="constant")
        return averaged

    x, y = rays[..., 0], rays[..., 1]
    share = mean(np.ones_like(depth))
    known = valid & (share >= _LEAST_SHARE)
    weight = np.where(known, share, 1.0)
    mx, my, mi = mean(x) / weight, mean(y) / weight, mean(inverse) / weight
    xx, yy, xy = mean(x * x) / weight - mx * mx, mean(y * y) / weight - my * my, mean(x * y) / weight - mx * my
    xi, yi = mean(x * inverse) / weight - mx * mi, mean(y * inverse) / weight - my * mi
    determinant = xx * yy - xy * xy
    known &= determinant > 1e-3 * (xx + yy) ** 2
    determinant = np.where(known, determinant, 1.0)
    a, b = (yy * xi - xy * yi) / determinant, (xx * yi - xy * xi) / determinant
    # 1/z = a x + b y + c: the plane's normal is (a, b, c), and its product with the ray (x, y, 1) is 1/z
    normal = np.stack([a, b, mi - a * mx - b * my], axis=-1)
    along = (normal * rays).sum(axis=-1)
    cosine = along / np.maximum(np.linalg.norm(normal, axis=-1) * np.linalg.norm(rays, axis=-1), 1e-12)
    return np.where(known, np.clip(cosine, _STEEPEST, 1.0), 0.0).astype(np.float32)
