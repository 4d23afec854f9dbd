"""Small rooms of primitives: a chair, a table, a bracket on it, and the fields of all of them."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from regnf_core.fields.mesh import MeshField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import LibraryObject, model_object

Matrix = NDArray[np.float64]


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def _legs(x: float, y: float, height: float, wide: float = 0.05) -> list[trimesh.Trimesh]:
    return [
        _box((sx * x - wide / 2, sy * y - wide / 2, 0.0), (sx * x + wide / 2, sy * y + wide / 2, height))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]


def chair() -> trimesh.Trimesh:
    """Its back is at the side of negative x, higher at one end: there is no symmetry."""
    parts = [_box((-0.22, -0.22, 0.42), (0.22, 0.22, 0.48)), *_legs(0.18, 0.18, 0.43)]
    parts += [_box((-0.22, -0.22, 0.45), (-0.17, 0.22, 0.85)), _box((-0.22, -0.22, 0.8), (-0.17, 0.0, 1.0))]
    return trimesh.util.concatenate(parts)


def table() -> trimesh.Trimesh:
    parts = [_box((-0.5, -0.35, 0.66), (0.5, 0.35, 0.72)), *_legs(0.42, 0.28, 0.68, 0.07)]
    return trimesh.util.concatenate([*parts, _box((-0.5, -0.35, 0.45), (-0.1, 0.35, 0.68))])


def bracket() -> trimesh.Trimesh:
    """Three unlike arms at right angles."""
    parts = [_box((0.0, 0.0, 0.0), (0.3, 0.08, 0.06)), _box((0.0, 0.0, 0.0), (0.08, 0.2, 0.06))]
    return trimesh.util.concatenate([*parts, _box((0.0, 0.0, 0.0), (0.07, 0.07, 0.25))])


def lamp() -> trimesh.Trimesh:
    """That stands in no room."""
    parts = [
        trimesh.creation.cylinder(radius=0.15, height=0.05, transform=_up(0.025)),
        trimesh.creation.cylinder(radius=0.03, height=1.2, transform=_up(0.6)),
        trimesh.creation.cone(radius=0.22, height=0.3, transform=_up(1.1)),
    ]
    return trimesh.util.concatenate(parts)


def _up(z: float) -> Matrix:
    T = np.eye(4)
    T[2, 3] = z
    return T


def pose(x: float, y: float, z: float, degrees: float) -> Matrix:
    """(4, 4): a turn about z, then a shift."""
    T = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 0, 1])
    T[:3, 3] = (x, y, z)
    return T


def room(things: list[tuple[trimesh.Trimesh, Matrix]]) -> MeshField:
    """A floor of 3.6 x 3 m, two walls, and things at their poses."""
    parts = [_box((-1.8, -1.5, -0.1), (1.8, 1.5, 0.0)), _box((-1.9, -1.5, -0.1), (-1.8, 1.5, 1.8))]
    parts += [_box((-1.9, 1.5, -0.1), (1.8, 1.6, 1.8))]
    parts += [mesh.copy().apply_transform(T) for mesh, T in things]
    whole = trimesh.util.concatenate(parts)
    return MeshField(whole.vertices, whole.faces)


def library(**meshes: trimesh.Trimesh) -> list[LibraryObject]:
    """Objects, each in its own frame."""
    found = []
    for name, mesh in meshes.items():
        field = MeshField(mesh.vertices, mesh.faces)
        found.append(LibraryObject(name, lambda field=field: field, model_object(field)))
    return found


def error_of(mesh: trimesh.Trimesh, T_scene_object: Sim3, truth: Matrix) -> float:
    """The largest distance between the mesh's vertices at both poses, shares of its diameter."""
    points = torch.from_numpy(np.asarray(mesh.vertices))
    there = T_scene_object.apply(points).numpy()
    true = points.numpy() @ truth[:3, :3].T + truth[:3, 3]
    extent = np.linalg.norm(np.ptp(points.numpy(), axis=0))
    return float(np.linalg.norm(there - true, axis=1).max() / extent)
