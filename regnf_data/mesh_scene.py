"""A scene of painted meshes that rays can be cast at, in meters, z up."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from regnf_core.fields.base import SdfField
from regnf_core.fields.composite import BoxField, UnionField
from regnf_core.importing.mesh_file import load_solid
from regnf_data.paint import Paint, TilePaint, paint_of

_SEEN_SHARE = 0.003
"""How much of its distance a hit may lie before a point that counts as seen."""


@dataclass(frozen=True)
class PaintedMesh:
    """Triangles with their color: vertices (V, 3), faces (F, 3)."""

    vertices: NDArray[np.float64]
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

    distance: NDArray[np.float64]
    thing: NDArray[np.int64]
    normal: NDArray[np.float64]
    color: NDArray[np.float64]


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


def box_thing(lower: ArrayLike, upper: ArrayLike, paint: TilePaint) -> Thing:
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
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3): lowest and highest corner of everything."""
        return UnionField([thing.solid for thing in self.things]).bounds.numpy()

    def signed_distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,): distance of points (N, 3) to the nearest thing, negative inside."""
        solids = UnionField([thing.solid for thing in self.things])
        return solids.signed_distance(torch.from_numpy(points)).numpy().astype(np.float64)

    def cast(self, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> Hits:
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
            color[chosen] = mesh.paint.at(points, corners, np.stack([1.0 - second - third, second, third], axis=1))
            normal[chosen] = answer["primitive_normals"][chosen]
            thing[chosen] = owner
        away = np.einsum("rc,rc->r", normal, directions) > 0.0
        normal[away] *= -1.0
        return Hits(distance, thing, normal, color)

    def sees(self, position: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(N,): whether nothing lies between ``position`` (3,) and the surface points (N, 3)."""
        distance = self._cast(np.broadcast_to(position, points.shape), points - position)["t_hit"]
        return np.asarray(distance >= 1.0 - _SEEN_SHARE)

    def _cast(self, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
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
