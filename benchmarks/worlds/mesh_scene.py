"""A scene of painted meshes that rays can be cast at, in meters, z up."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from benchmarks.solids import BoxField, UnionField
from regnf_core.fields.observation import SdfField
from regnf_core.importing.mesh_file import load_solid

# What color a mesh has at a point of its surface. All colors are linear, not sRGB, from 0 to 1.

_GRAY = (0.5, 0.5, 0.5)


Array = NDArray[np.float64]
Rgb = tuple[float, float, float]
Paint = Callable[[Array, NDArray[np.int64], Array], Array]
"""Colors (P, 3) at points (P, 3), each the mix by shares (P, 3) of a triangle's vertices (P, 3)."""


def vertex_paint(colors: Array) -> Paint:
    """One color a vertex, (V, 3), mixed over the triangle."""
    return lambda points, corners, shares: np.einsum("pk,pkc->pc", shares, colors[corners])


def texture_paint(picture: NDArray[np.float32], coordinates: Array) -> Paint:
    """The nearest texels of a picture (h, w, 3) laid on by coordinates (V, 2); (0, 0) is its lower left corner, and it
    repeats."""
    height, width = picture.shape[:2]

    def at(_: Array, corners: NDArray[np.int64], shares: Array) -> Array:
        u, v = np.einsum("pk,pkc->cp", shares, coordinates[corners])
        column = np.floor(u * width).astype(np.int64) % width
        row = np.floor((1.0 - v) * height).astype(np.int64) % height
        texels: Array = picture[row, column].astype(np.float64)
        return texels

    return at


def tile_paint(first: Rgb, second: Rgb, edge: float) -> Paint:
    """Cubes of two colors in turn, ``edge`` long: what floors and walls wear, so that images show them move."""

    def at(points: Array, _corners: NDArray[np.int64], _shares: Array) -> Array:
        # Off the faces by a part of a tile: rounding must not choose the color.
        odd = np.floor(points / edge + 0.3).sum(axis=1) % 2 == 1
        return np.where(odd[:, None], first, second)

    return at


def paint_of(mesh: Any) -> Paint:
    """The paint that a trimesh mesh comes with: its base texture, its vertices' or faces' colors, or else gray."""
    visual = mesh.visual
    material = getattr(visual, "material", None)
    coordinates = getattr(visual, "uv", None)
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if picture is not None and coordinates is not None and len(coordinates) == len(mesh.vertices):
        factor = getattr(material, "baseColorFactor", None)
        tint = 1.0 if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255.0
        linear = to_linear(np.asarray(picture.convert("RGB"))) * tint
        return texture_paint(linear.astype(np.float32), np.asarray(coordinates, dtype=np.float64))
    if visual.kind not in (None, "texture"):
        return vertex_paint(to_linear(np.asarray(visual.vertex_colors)[:, :3]))
    main = getattr(material, "main_color", None)
    color = np.array(_GRAY) if main is None else to_linear(np.asarray(main)[:3])
    return vertex_paint(np.tile(color, (len(mesh.vertices), 1)))


def to_linear(srgb: NDArray[Any]) -> Array:
    """sRGB bytes to linear light, 0 to 1 (IEC 61966-2-1)."""
    steps = np.arange(256) / 255.0
    table = np.where(steps <= 0.04045, steps / 12.92, ((steps + 0.055) / 1.055) ** 2.4)
    linear: Array = table[srgb.astype(np.uint8)]
    return linear


def to_srgb(linear: Array) -> NDArray[np.uint8]:
    """Linear light, 0 to 1, to sRGB bytes (IEC 61966-2-1)."""
    light = np.clip(linear, 0.0, 1.0)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return np.round(encoded * 255.0).astype(np.uint8)


_SEEN_SHARE = 0.003
"""How much of its distance a hit may lie before a point that counts as seen."""


@dataclass(frozen=True)
class PaintedMesh:
    """Triangles with their color: vertices (V, 3), faces (F, 3)."""

    vertices: Array
    faces: NDArray[np.int64]
    paint: Paint


@dataclass(frozen=True)
class Thing:
    """One solid of the scene. meshes: what is seen of it · solid: its exact distance field · name: None for walls."""

    meshes: tuple[PaintedMesh, ...]
    solid: SdfField
    name: str | None = None


@dataclass(frozen=True)
class Hits:
    """What R rays met first.

    distance: (R,), in lengths of the ray's direction, inf where nothing was met · thing: (R,) index, -1 for none ·
    normal: (R, 3) unit, towards the ray's origin · color: (R, 3) linear, zero where nothing was met.
    """

    distance: Array
    thing: NDArray[np.int64]
    normal: Array
    color: Array


def load_thing(path: str | os.PathLike[str], T_scene_mesh: ArrayLike | None = None, name: str | None = None) -> Thing:
    """The meshes of a glb, ply, obj or stl file at a pose. Raises FieldFormatError (MESH_INVALID) and OSError."""
    import trimesh

    matrix = np.eye(4) if T_scene_mesh is None else np.asarray(T_scene_mesh, dtype=np.float64)
    solid = load_solid(path, "object")[0].transformed(matrix)  # refuses what is malformed
    scene = trimesh.load_scene(os.fspath(path), process=False)
    meshes = tuple(
        PaintedMesh(
            np.asarray(mesh.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3],
            np.asarray(mesh.faces, dtype=np.int64),
            paint_of(mesh),
        )
        for mesh in scene.dump()
        if isinstance(mesh, trimesh.Trimesh)
    )
    return Thing(meshes, solid, name)


def box_thing(lower: ArrayLike, upper: ArrayLike, paint: Paint) -> Thing:
    """A box between two corners (3,): a floor or a wall."""
    corners = np.array([lower, upper], dtype=np.float64)
    vertices = np.array([[corners[i, 0], corners[j, 1], corners[k, 2]] for i, j, k in product((0, 1), repeat=3)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    low, high = (tuple(corner) for corner in corners.tolist())
    return Thing((PaintedMesh(vertices, np.array(faces), paint),), BoxField(low, high))


class MeshScene:
    """Things that stand still."""

    def __init__(self, things: Sequence[Thing]) -> None:
        self.things = tuple(things)
        self._meshes = [(index, mesh) for index, thing in enumerate(self.things) for mesh in thing.meshes]

    @cached_property
    def bounds(self) -> Array:
        """(2, 3): lowest and highest corner of everything."""
        return UnionField([thing.solid for thing in self.things]).bounds.numpy()

    def signed_distance(self, points: Array) -> Array:
        """(N,): distance of points (N, 3) to the nearest thing, negative inside."""
        solids = UnionField([thing.solid for thing in self.things])
        return solids.signed_distance(torch.from_numpy(points)).numpy().astype(np.float64)

    def cast(self, origins: Array, directions: Array) -> Hits:
        """What the rays from ``origins`` (R, 3) along ``directions`` (R, 3), of any length, meet first."""
        answer = self._cast(origins, directions)
        distance = answer["t_hit"].astype(np.float64)
        mesh_index = np.where(np.isfinite(distance), answer["geometry_ids"].astype(np.int64), -1)
        normal = np.zeros((len(distance), 3))
        color = np.zeros((len(distance), 3))
        thing = np.full(len(distance), -1, dtype=np.int64)
        for index, (owner, mesh) in enumerate(self._meshes):
            chosen = mesh_index == index
            corners = mesh.faces[answer["primitive_ids"][chosen].astype(np.int64)]
            second, third = answer["primitive_uvs"][chosen].astype(np.float64).T
            points = origins[chosen] + distance[chosen, None] * directions[chosen]
            color[chosen] = mesh.paint(points, corners, np.stack([1.0 - second - third, second, third], axis=1))
            normal[chosen] = answer["primitive_normals"][chosen]
            thing[chosen] = owner
        away = np.einsum("rc,rc->r", normal, directions) > 0.0
        normal[away] *= -1.0
        return Hits(distance, thing, normal, color)

    def sees(self, position: Array, points: Array) -> NDArray[np.bool_]:
        """(N,): whether nothing lies between ``position`` (3,) and the surface points (N, 3)."""
        distance = self._cast(np.broadcast_to(position, points.shape), points - position)["t_hit"]
        return np.asarray(distance >= 1.0 - _SEEN_SHARE)

    def _cast(self, origins: Array, directions: Array) -> dict[str, NDArray[Any]]:
        import open3d

        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        answer = self._rays.cast_rays(open3d.core.Tensor.from_numpy(rays))
        return {name: value.numpy() for name, value in answer.items()}

    @cached_property
    def _rays(self) -> Any:
        import open3d

        scene = open3d.t.geometry.RaycastingScene()
        for _, mesh in self._meshes:
            parts = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
            scene.add_triangles(*(open3d.core.Tensor.from_numpy(part) for part in parts))
        return scene
