"""Depth images of an exact scene, with and without noise."""

from __future__ import annotations

import numpy as np
import open3d
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.robust.one_view_field import Array, DepthImage, directions

PIXELS = 400
REACH = float(np.tan(np.radians(30.0)))
_NOISE_PIXELS = 2.0


class DepthCamera:
    """Looks at triangles: vertices (V, 3), faces (F, 3), scene frame, z up. Nothing is farther than ``far``."""

    def __init__(self, vertices: NDArray[np.float32], faces: NDArray[np.int32], far: float) -> None:
        self._scene = open3d.t.geometry.RaycastingScene()
        as_tensor = open3d.core.Tensor.from_numpy
        self._scene.add_triangles(as_tensor(vertices.astype(np.float32)), as_tensor(faces.astype(np.uint32)))
        self.far = far

    def look(self, position: Array, target: Array, pixels: int = PIXELS, reach: float = REACH) -> DepthImage:
        """The depth image from ``position`` (3,) towards ``target`` (3,)."""
        axes = looking(position, target)
        rays = directions(pixels, reach) @ axes.T
        both = np.concatenate([np.broadcast_to(position, rays.shape), rays], axis=-1).astype(np.float32)
        # Directions have a forward component of 1, so the ray's parameter is the depth.
        depth = self._scene.cast_rays(open3d.core.Tensor.from_numpy(both))["t_hit"].numpy().astype(np.float64)
        return DepthImage(position, axes, reach, np.minimum(depth, self.far))


def noisy(image: DepthImage, deviation: float, seed: int) -> DepthImage:
    """The image with Gaussian errors of the depth, alike in neighboring pixels. deviation: scene units."""
    white = np.random.default_rng(seed).normal(size=image.depth.shape)
    smooth = ndimage.gaussian_filter(white, _NOISE_PIXELS, mode="wrap")
    depth = image.depth + deviation * smooth / smooth.std()
    return DepthImage(image.position, image.axes, image.reach, np.maximum(depth, 1e-3))


def looking(position: Array, target: Array) -> Array:
    """(3, 3): columns right, down, forward of a level camera."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=-1)
