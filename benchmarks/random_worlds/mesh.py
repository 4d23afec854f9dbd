"""Triangle meshes made of simple closed parts that may overlap: the winding number says what is inside."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.worlds.rendering import Size, camera_rays

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_BOX_FACES = np.array([face for a, b, c, d in _QUADS for face in ((a, b, c), (a, c, d))], dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Mesh:
    """vertices: (V, 3) meters · faces: (F, 3) indices, normals outward."""

    vertices: Array
    faces: Faces

    def moved(self, T: ArrayLike) -> Mesh:
        """The same carried by an affine matrix (4, 4)."""
        matrix = np.asarray(T, dtype=np.float64)
        mesh = Mesh(self.vertices @ matrix[:3, :3].T + matrix[:3, 3], self.faces)
        mesh.__dict__["edges"] = self.edges  # the same, and slow to find
        return mesh

    def shifted(self, *by: float) -> Mesh:
        """The same carried along x, y, z."""
        return Mesh(self.vertices + np.array(by), self.faces)

    @cached_property
    def bounds(self) -> Array:
        """(2, 3): lowest and highest corner of all faces."""
        used = self.vertices[np.unique(self.faces)]
        return np.stack([used.min(axis=0), used.max(axis=0)])

    @property
    def size(self) -> Array:
        """(3,): edges of the bounds."""
        edges: Array = self.bounds[1] - self.bounds[0]
        return edges

    @cached_property
    def edges(self) -> Faces:
        """(E, 2): every edge once."""
        pairs = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        return np.asarray(np.unique(pairs, axis=0))

    @cached_property
    def normals_and_areas(self) -> tuple[Array, Array]:
        """Unit normals (F, 3) and areas (F,)."""
        first, second, third = (self.vertices[self.faces[:, corner]] for corner in range(3))
        cross = np.cross(second - first, third - first)
        length = np.linalg.norm(cross, axis=1)
        return cross / np.maximum(length, 1e-300)[:, None], length / 2.0

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """``count`` points (count, 3), even over the area, and their normals."""
        normals, areas = self.normals_and_areas
        chosen = rng.choice(len(self.faces), size=count, p=areas / areas.sum())
        a, b = rng.random((2, count, 1))
        a, b = np.where(a + b > 1.0, 1.0 - a, a), np.where(a + b > 1.0, 1.0 - b, b)
        corner, first, second = (self.vertices[self.faces[chosen, i]] for i in range(3))
        return corner + a * (first - corner) + b * (second - corner), normals[chosen]

    def cast(self, origins: Array, directions: Array) -> Array:
        """(R,): how far, in lengths of ``directions`` (R, 3), rays from ``origins`` (R, 3) go before they hit it."""
        import open3d

        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        distance: Array = self._rays.cast_rays(open3d.core.Tensor.from_numpy(rays))["t_hit"].numpy().astype(np.float64)
        return distance

    def pierced_by(self, other: Mesh) -> bool:
        """Whether an edge of the other mesh goes through a face of this one."""
        import open3d

        start, end = (other.vertices[other.edges[:, i]] for i in (0, 1))
        low, high = self.bounds
        near = (np.maximum(start, end) >= low).all(axis=1) & (np.minimum(start, end) <= high).all(axis=1)
        if not near.any():
            return False
        rays = np.concatenate([start, end - start], axis=1)[near].astype(np.float32)
        hit = self._rays.test_occlusions(open3d.core.Tensor.from_numpy(rays), 0.0, 1.0)
        return bool(hit.numpy().any())

    @cached_property
    def _rays(self) -> Any:
        return ray_scene([self])


def ray_scene(meshes: Sequence[Mesh]) -> Any:
    """Open3D's scene of meshes that rays can be cast at; a mesh's number is its geometry's id."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    for mesh in meshes:
        parts = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
        scene.add_triangles(*(open3d.core.Tensor.from_numpy(np.ascontiguousarray(part)) for part in parts))
    return scene


def together(*parts: Mesh) -> Mesh:
    """All parts as one mesh."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


def standing(mesh: Mesh) -> Mesh:
    """The same with the lowest point at z = 0 and the footprint's middle at x = y = 0."""
    low, high = mesh.bounds
    return mesh.shifted(-(low[0] + high[0]) / 2.0, -(low[1] + high[1]) / 2.0, -low[2])


def box(lower: ArrayLike, upper: ArrayLike) -> Mesh:
    """A box between two corners (3,)."""
    corners = np.array([lower, upper], dtype=np.float64)
    vertices = np.array([[corners[i, 0], corners[j, 1], corners[k, 2]] for i, j, k in product((0, 1), repeat=3)])
    return Mesh(vertices, _BOX_FACES)


def block(center: Sequence[float], size: Sequence[float]) -> Mesh:
    """A box about a middle (3,), full edges (3,)."""
    middle, half = np.asarray(center, dtype=np.float64), np.asarray(size, dtype=np.float64) / 2.0
    return box(middle - half, middle + half)


def beam(start: Sequence[float], end: Sequence[float], width: float, depth: float) -> Mesh:
    """A bar of rectangular section between two points: ``width`` lies level, ``depth`` across."""
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    frame = _frame_along(last - first)
    bar = box((-width / 2.0, -depth / 2.0, 0.0), (width / 2.0, depth / 2.0, float(np.linalg.norm(last - first))))
    return Mesh(bar.vertices @ frame.T + first, bar.faces)


def rod(
    start: Sequence[float], end: Sequence[float], radius: float, end_radius: float | None = None, sides: int = 12
) -> Mesh:
    """A round bar between two points; ``end_radius`` for a tapered one."""
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(last - first))
    other = radius if end_radius is None else end_radius
    bar = turned([(0.0, 0.0), (radius, 0.0), (other, length), (0.0, length)], sides)
    return Mesh(bar.vertices @ _frame_along(last - first).T + first, bar.faces)


def tube(points: ArrayLike, radius: float, sides: int = 8) -> Mesh:
    """A round bar along a line of points (P, 3), with balls at its bends."""
    line = np.asarray(points, dtype=np.float64)
    rods = [rod(a, b, radius, sides=sides) for a, b in pairwise(line.tolist())]
    return together(*rods, *(ball(point, radius, sides) for point in line[1:-1].tolist()))


def ball(center: Sequence[float], radius: float, sides: int = 12) -> Mesh:
    """A sphere."""
    angles = np.linspace(-math.pi / 2.0, math.pi / 2.0, max(sides // 2, 3) + 1)
    profile = [(radius * max(math.cos(a), 0.0), radius * math.sin(a)) for a in angles.tolist()]
    return turned(profile, sides).shifted(*center)


def turned(profile: Sequence[tuple[float, float]], sides: int = 40) -> Mesh:
    """A solid of revolution about z: (radius, height) from where it meets the axis to where it meets it again.

    The profile runs so that matter lies to its left: up on the outside.
    """
    angles = 2.0 * math.pi * np.arange(sides) / sides
    rings = [np.stack([r * np.cos(angles), r * np.sin(angles), np.full(sides, z)], axis=1) for r, z in profile]
    vertices = np.concatenate(rings)
    faces = []
    here = np.arange(sides)
    there = (here + 1) % sides
    for level in range(len(profile) - 1):
        low, high = level * sides, (level + 1) * sides
        faces.append(np.stack([low + here, low + there, high + there], axis=1))
        faces.append(np.stack([low + here, high + there, high + here], axis=1))
    return _without_empty(Mesh(vertices, np.concatenate(faces)))


def disc(center: Sequence[float], radii: tuple[float, float], thickness: float, sides: int = 48) -> Mesh:
    """A round or oval slab, its lowest face about ``center``."""
    flat = turned([(0.0, 0.0), (1.0, 0.0), (1.0, thickness), (0.0, thickness)], sides)
    return Mesh(flat.vertices * np.array([*radii, 1.0]) + np.asarray(center, dtype=np.float64), flat.faces)


def turn_about_z(angle: float) -> Array:
    """(4, 4)."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return matrix


def _frame_along(direction: Array) -> Array:
    """(3, 3): columns; the third along ``direction``, the first level."""
    z = direction / np.linalg.norm(direction)
    up = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _without_empty(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[mesh.normals_and_areas[1] > 1e-14])


# The exact surfaces of a world, for rays, distances and free ways.

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
