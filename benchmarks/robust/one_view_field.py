"""The field that one depth image tells of: what the camera sees through is free, everything behind is solid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
_LONGEST = 0.1
"""Longest edge of a triangle, shares of the greatest depth."""
_ON_SURFACE = 1e-4  # shares of the greatest depth: nearer, float32 does not tell the way to the surface


@dataclass(frozen=True, eq=False)
class DepthImage:
    """Depths along the camera's axis at the corners of a square grid of pixels.

    position: (3,) scene frame · axes: (3, 3), columns right, down, forward, scene frame · reach: tangent of half the
    angle of view · depth: (N, N), rows downwards, scene units.
    """

    position: Array
    axes: Array
    reach: float
    depth: Array

    def points(self) -> Array:
        """What was seen (N, N, 3), scene frame."""
        return self.position + self.depth[..., None] * (directions(len(self.depth), self.reach) @ self.axes.T)


def directions(count: int, reach: float) -> Array:
    """Where the grid's corners look, (count, count, 3), camera axes, forward component 1."""
    across = np.linspace(-reach, reach, count)
    u, v = np.meshgrid(across, across)
    return np.stack([u, v, np.ones_like(u)], axis=-1)


class OneViewField:
    """Exact signed distance to the border of the free space in front of a depth image; solid outside its view too.

    The image is taken as a surface of triangles between neighboring pixels' depths: where one lies far behind the
    other they form a wall along the line of sight, the border of a shadow. bounds: (2, 3), scene frame.
    """

    def __init__(self, image: DepthImage, bounds: Tensor) -> None:
        self.image = image
        self.bounds = bounds
        # A search tree is slow, and float32 less exact, over the long slivers along the lines of sight.
        self.vertices, self.faces = with_short_edges(*triangles(image), _LONGEST * float(image.depth.max()))
        self._surface = open3d.t.geometry.RaycastingScene()
        as_tensor = open3d.core.Tensor.from_numpy
        self._surface.add_triangles(
            as_tensor(self.vertices.astype(np.float32)), as_tensor(self.faces.astype(np.uint32))
        )

    @property
    def device(self) -> torch.device:
        """Always the CPU."""
        return torch.device("cpu")

    def to(self, device: torch.device | str) -> OneViewField:
        """This field."""
        del device
        return self

    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3)."""
        return self.signed_distance_and_gradient(points)[0]

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) float32 at points (N, 3) and its gradient (N, 3)."""
        queries = np.ascontiguousarray(points.detach().cpu().numpy(), dtype=np.float64)
        asked = open3d.core.Tensor.from_numpy(queries.astype(np.float32))
        found = self._surface.compute_closest_points(asked, nthreads=torch.get_num_threads())
        away = queries - found["points"].numpy()
        sign = np.where(self.sees(queries), 1.0, -1.0)
        distance = np.linalg.norm(away, axis=-1)
        gradient = away * (sign / np.maximum(distance, 1e-12))[:, None]
        # On the surface itself the way to the nearest point is rounding error: the normal of the triangle is meant,
        # which winds away from the camera.
        on_surface = distance < _ON_SURFACE * float(self.image.depth.max())
        gradient[on_surface] = -found["primitive_normals"].numpy()[on_surface]
        return _as_float32(sign * distance), _as_float32(gradient)

    def sees(self, points: Array) -> NDArray[np.bool_]:
        """(N,): which points (N, 3) lie in view and in front of the surface."""
        image, cells = self.image, len(self.image.depth) - 1
        local = (points - image.position) @ image.axes
        ahead = local[:, 2] > 1e-9
        forward = np.where(ahead, local[:, 2], 1.0)
        place = (local[:, :2] / forward[:, None] / image.reach + 1.0) / 2.0 * cells  # (N, 2), in pixels
        in_view = ahead & ((place >= 0.0) & (place <= cells)).all(axis=-1)
        cell = np.clip(np.floor(place), 0, cells - 1).astype(int)
        u, v = (place - cell).T
        # Along a triangle the inverse of the depth is linear in the image, so this is exact.
        inverse = 1.0 / image.depth
        corner = inverse[cell[:, 1], cell[:, 0]]
        opposite = inverse[cell[:, 1] + 1, cell[:, 0] + 1]
        right, below = inverse[cell[:, 1], cell[:, 0] + 1], inverse[cell[:, 1] + 1, cell[:, 0]]
        upper = corner + u * (right - corner) + v * (opposite - right)
        lower = corner + v * (below - corner) + u * (opposite - below)
        seen: NDArray[np.bool_] = in_view & (1.0 / forward > np.where(u >= v, upper, lower))
        return seen


def triangles(image: DepthImage) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (V, 3) and faces (F, 3): the seen surface, and the sides of the view from the camera to its border."""
    count = len(image.depth)
    number = np.arange(count * count).reshape(count, count)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    border = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    camera = np.full(len(border), count * count)
    faces.append(np.stack([camera, np.roll(border, -1), border], axis=-1))
    vertices = np.concatenate([image.points().reshape(-1, 3), image.position[None]])
    return vertices, np.concatenate(faces).astype(np.int64)


def with_short_edges(vertices: Array, faces: NDArray[np.int64], longest: float) -> tuple[Array, NDArray[np.int64]]:
    """The same surface, triangles halved across their longest edge until none is longer than ``longest``."""
    while True:
        corners = vertices[faces]  # (F, 3, 3)
        lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)
        edge = lengths.argmax(axis=-1)
        long = lengths.max(axis=-1) > longest
        if not long.any():
            return vertices, faces
        a, b, c = (np.take_along_axis(faces[long], (edge[long] + k)[:, None] % 3, axis=1)[:, 0] for k in range(3))
        middle = len(vertices) + np.arange(len(a))
        vertices = np.concatenate([vertices, (vertices[a] + vertices[b]) / 2])
        halves = [np.stack([a, middle, c], axis=-1), np.stack([middle, b, c], axis=-1)]
        faces = np.concatenate([faces[~long], *halves])


def _as_float32(values: NDArray[Any]) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))
