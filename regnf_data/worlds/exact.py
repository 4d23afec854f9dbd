"""The exact surfaces of a world, for rays, distances and free ways."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_data.rendering import Size, camera_rays
from regnf_data.worlds.mesh import Array, Mesh, ray_scene

_CEILING_M = 2.0
"""What stands lower than this bars the way of a walker."""
_STEP_M = 0.02


@dataclass(frozen=True)
class ExactView:
    """An exact image. depth: (H, W) along the camera's axis, 0 where nothing is · thing: (H, W), -1 for none ·

    cosine: (H, W) between ray and normal.
    """

    depth: Array
    thing: NDArray[np.int64]
    cosine: Array


class ExactScene:
    """Meshes that stand still; a thing's number is its place among them."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        self.meshes = tuple(meshes)

    def view(self, size: Size, intrinsics: Array, pose: Array) -> ExactView:
        """What a camera at ``pose`` (4, 4; OpenCV's axes) sees."""
        origins, directions = camera_rays(size, intrinsics, pose)
        answer = self._cast(origins, directions)
        distance = answer["t_hit"].reshape(size).astype(np.float64)
        hit = np.isfinite(distance)
        length = np.linalg.norm(directions, axis=1)
        cosine = np.abs(np.einsum("rc,rc->r", answer["primitive_normals"], directions)) / length
        thing = np.where(hit, answer["geometry_ids"].reshape(size).astype(np.int64), -1)
        return ExactView(np.where(hit, distance, 0.0), thing, cosine.reshape(size))

    def distance(self, points: Array) -> Array:
        """(N,): unsigned distance of points (N, 3) to the nearest surface."""
        import open3d

        asked = open3d.core.Tensor.from_numpy(np.ascontiguousarray(points, dtype=np.float32))
        found: Array = self._rays.compute_distance(asked).numpy().astype(np.float64)
        return found

    def signed_distance(self, points: Array) -> Array:
        """(N,): for a walker; negative above and below what stands in his way."""
        above = points.copy()
        above[:, 2] = _CEILING_M
        down = np.tile((0.0, 0.0, -1.0), (len(points), 1))
        top = _CEILING_M - self._cast(above, down)["t_hit"].astype(np.float64)
        distance = self.distance(points)
        return np.where(top > _STEP_M, -distance, distance)

    def sees(self, origins: Array, targets: Array) -> NDArray[np.bool_]:
        """(N,): whether nothing lies between points (N, 3)."""
        way = self._cast(origins, targets - origins)["t_hit"]
        return np.asarray(way > 0.999)

    def _cast(self, origins: Array, directions: Array) -> dict[str, NDArray[Any]]:
        import open3d

        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        answer = self._rays.cast_rays(open3d.core.Tensor.from_numpy(rays))
        return {name: answer[name].numpy() for name in ("t_hit", "geometry_ids", "primitive_normals")}

    @cached_property
    def _rays(self) -> Any:
        return ray_scene(self.meshes)
