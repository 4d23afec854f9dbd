"""Mesh fields against closed forms, and against a slow evaluation of point and triangle of its own."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from regnf_core.fields.mesh import MeshField
from tests.core.importing.meshes.test_facing import FURNISHED, converted

Points = NDArray[np.float64]


def evaluated(mesh: trimesh.Trimesh, points: Points, **said: str) -> NDArray[np.float32]:
    found = converted(mesh, **said)
    level = float(found.description["inside_above"])
    field = MeshField(found.tensors["vertices"], found.tensors["faces"], inside_above=level)
    return field.signed_distance(torch.from_numpy(points)).numpy()


def to_ball(points: Points) -> Points:
    return np.asarray(np.linalg.norm(points, axis=1) - 0.8)


def to_box(points: Points) -> Points:
    beyond = np.abs(points) - np.array([0.5, 0.4, 0.7])
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0))


def to_torus(points: Points) -> Points:
    return np.asarray(np.hypot(np.hypot(points[:, 0], points[:, 1]) - 0.7, points[:, 2]) - 0.2)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize(
    ("mesh", "expected", "facets"),
    [
        (trimesh.creation.icosphere(4, 0.8), to_ball, 2e-3),
        (trimesh.creation.box((1.0, 0.8, 1.4)), to_box, 1e-6),
        (trimesh.creation.torus(0.7, 0.2, 256, 128), to_torus, 2e-4),
    ],
    ids=["ball", "box", "torus"],
)
def test_closed_forms(mesh: trimesh.Trimesh, expected: object, facets: float, inverted: bool) -> None:
    """``facets``: how far the triangles lie beneath the smooth surface."""
    assert callable(expected)
    points = np.random.default_rng(2).uniform(-1.0, 1.0, (500, 3))
    faces = mesh.faces[:, ::-1] if inverted else mesh.faces
    turned = trimesh.Trimesh(mesh.vertices, faces, process=False)
    np.testing.assert_allclose(evaluated(turned, points, **{"as": "object"}), expected(points), rtol=0, atol=facets)


def slow_distance(point: Points, a: Points, b: Points, c: Points) -> float:
    """To a triangle: within it, where the foot of the perpendicular is; else to the nearest of its edges."""
    normal = np.cross(b - a, c - a)
    foot = point - normal * (normal @ (point - a)) / (normal @ normal)
    sides = [np.cross(q - p, foot - p) @ normal for p, q in ((a, b), (b, c), (c, a))]
    if min(sides) >= 0:
        return float(np.linalg.norm(point - foot))
    nearest = []
    for p, q in ((a, b), (b, c), (c, a)):
        share = np.clip((point - p) @ (q - p) / ((q - p) @ (q - p)), 0.0, 1.0)
        nearest.append(np.linalg.norm(point - p - share * (q - p)))
    return float(min(nearest))


def solid_angle(point: Points, a: Points, b: Points, c: Points) -> float:
    """Van Oosterom and Strackee (1983), signed: positive behind the triangle."""
    a, b, c = a - point, b - point, c - point
    x, y, z = (float(np.linalg.norm(v)) for v in (a, b, c))
    over = float(a @ np.cross(b, c))
    return 2.0 * float(np.arctan2(over, x * y * z + a @ b * z + b @ c * x + c @ a * y))


def test_triangles_one_by_one() -> None:
    """A room with a hole in its wall: each triangle's distance and solid angle added up by hand."""
    kept = np.linalg.norm(FURNISHED.triangles_center - [2.0, 0.0, 1.5], axis=1) > 0.5
    room = trimesh.Trimesh(FURNISHED.vertices, FURNISHED.faces[kept], process=False)
    level = float(converted(room, **{"as": "scene"}).description["inside_above"])
    points = np.random.default_rng(3).uniform([-0.2, -0.2, -0.2], [4.2, 3.2, 2.7], (12, 3))
    found = evaluated(room, points, **{"as": "scene"})
    for point, value in zip(points, found, strict=True):
        winding = sum(solid_angle(point, *triangle) for triangle in room.triangles) / (4.0 * np.pi)
        nearest = min(slow_distance(point, *triangle) for triangle in room.triangles)
        assert abs(winding - level) > 0.02
        assert value == pytest.approx(-nearest if winding > level else nearest, abs=1e-5)
