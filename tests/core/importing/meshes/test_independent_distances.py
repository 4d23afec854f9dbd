"""Mesh fields against a slow evaluation of point and triangle of its own."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from tests.core.importing.meshes.test_facing import FURNISHED, converted, distance

Points = NDArray[np.float64]


def distance_to(point: Points, triangles: Points) -> float:
    """To the nearest of (T, 3, 3): the foot of the perpendicular where it is within, else the nearest of the edges."""
    corners, following = triangles, np.roll(triangles, -1, axis=1)
    sides = following - corners
    normal = np.cross(sides[:, 0], sides[:, 1])
    height = np.sum(normal * (point - corners[:, 0]), axis=1) / np.sum(normal**2, axis=1)
    foot = point - normal * height[:, None]
    turns = np.sum(np.cross(sides, foot[:, None] - corners) * normal[:, None], axis=2)  # (T, 3): its side of each edge
    share = np.clip(np.sum((point - corners) * sides, axis=2) / np.sum(sides**2, axis=2), 0.0, 1.0)
    to_edges = np.linalg.norm(point - corners - share[..., None] * sides, axis=2).min(axis=1)
    to_faces = np.linalg.norm(point - foot, axis=1)
    return float(np.where(turns.min(axis=1) >= 0, to_faces, to_edges).min())


def solid_angle(point: Points, triangles: Points) -> float:
    """Of all triangles (T, 3, 3): Van Oosterom and Strackee (1983), signed, positive behind a triangle."""
    a, b, c = np.moveaxis(triangles - point, 1, 0)
    x, y, z = (np.linalg.norm(one, axis=1) for one in (a, b, c))
    over = np.sum(a * np.cross(b, c), axis=1)
    under = x * y * z + np.sum(a * b, axis=1) * z + np.sum(b * c, axis=1) * x + np.sum(c * a, axis=1) * y
    return float(2.0 * np.arctan2(over, under).sum())


def test_distances_and_solid_angles_by_hand() -> None:
    """A room with a hole in its wall: the nearest triangle, and all their solid angles added up."""
    kept = np.linalg.norm(FURNISHED.triangles_center - [2.0, 0.0, 1.5], axis=1) > 0.5
    room = trimesh.Trimesh(FURNISHED.vertices, FURNISHED.faces[kept], process=False)
    scene = converted(room, **{"as": "scene"})
    level = float(scene.description["inside_above"])
    points = np.random.default_rng(3).uniform([-0.2, -0.2, -0.2], [4.2, 3.2, 2.7], (12, 3))
    found = distance(scene, points)
    for point, value in zip(points, found, strict=True):
        winding = solid_angle(point, room.triangles) / (4.0 * np.pi)
        nearest = distance_to(point, room.triangles)
        assert abs(winding - level) > 0.02
        assert value == pytest.approx(-nearest if winding > level else nearest, abs=1e-5)
