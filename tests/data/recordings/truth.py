"""A recording whose truth is known by formulas: a room with three balls and a box, seen by a camera that walks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HEIGHT, WIDTH = 60, 80
K = np.array([[70.0, 0.0, 39.0], [0.0, 72.0, 31.0], [0.0, 0.0, 1.0]])
"""As sensors write it: a pixel's center at whole numbers."""
_LOW, _HIGH = np.array([-2.0, -1.5, 0.0]), np.array([2.0, 2.5, 2.2])
_BALLS = (((0.5, 1.0, 0.4), 0.4), ((-0.7, 0.6, 0.3), 0.3), ((0.0, 1.6, 1.0), 0.25))
_BOX = np.array([[-1.4, 1.2, 0.0], [-0.8, 1.8, 0.9]])


@dataclass(frozen=True, eq=False)
class Truth:
    """depths: (N, H, W), meters along the axis · colors: (N, H, W, 3) · poses: (N, 4, 4), camera to world, OpenCV's
    axes · stamps: (N,), s."""

    depths: Array
    colors: NDArray[np.uint8]
    poses: Array
    stamps: Array

    def __len__(self) -> int:
        return len(self.depths)


def walk(count: int = 6) -> Truth:
    """Cameras on an arc that look at the middle of the room."""
    poses = []
    for angle in np.linspace(-0.6, 0.6, count):
        place = np.array([1.3 * np.sin(angle), -1.0 + 0.3 * np.cos(3 * angle), 1.1 + 0.2 * np.sin(5 * angle)])
        forward = np.array([0.1, 1.2, 0.5]) - place
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = place
        poses.append(pose)
    seen = [_cast(pose) for pose in poses]
    depths = np.stack([depth for depth, _ in seen])
    return Truth(depths, np.stack([color for _, color in seen]), np.stack(poses), 100.0 + 0.1 * np.arange(count))


def _cast(pose: Array) -> tuple[Array, NDArray[np.uint8]]:
    v, u = np.indices((HEIGHT, WIDTH)).astype(np.float64)
    local = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    rays = local @ pose[:3, :3].T
    start = pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        near = np.where(rays > 0.0, (_HIGH - start) / rays, (_LOW - start) / rays).min(axis=-1)
        for center, radius in _BALLS:
            offset = start - np.array(center)
            a, b, c = (rays**2).sum(-1), (rays @ offset), (offset**2).sum() - radius**2
            root = b * b - a * c
            hit = (-b - np.sqrt(np.maximum(root, 0.0))) / a
            near = np.where((root > 0.0) & (hit > 0.0) & (hit < near), hit, near)
        first, second = (_BOX[0] - start) / rays, (_BOX[1] - start) / rays
        enter, leave = np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)
        near = np.where((enter < leave) & (enter > 0.0) & (enter < near), enter, near)
    points = start + rays * near[..., None]
    color = np.clip(60.0 + 80.0 * np.abs(np.sin(2.0 * points)), 0, 255).astype(np.uint8)
    return near, color
