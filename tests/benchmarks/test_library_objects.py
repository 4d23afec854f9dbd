"""The 64 objects of the library search: no two are similar."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from benchmarks.robust.library_objects import library_meshes
from regnf_core.fields.mesh import MeshField
from tests.devdata import dev_data


def shape_of(mesh: MeshField) -> NDArray[np.float64]:
    """Numbers that no rotation, shift or scale changes: main radii, spread of the distances to the middle, area."""
    points = mesh.sample_surface(3000, np.random.default_rng(0))
    points = points - points.mean(0)
    radii = np.sqrt(np.linalg.eigvalsh(np.cov(points.T)))
    distance = np.linalg.norm(points, axis=1)
    size = np.sqrt((distance**2).mean())
    spread = np.quantile(distance, [0.1, 0.25, 0.5, 0.75, 0.9])
    return np.concatenate([radii / size, spread / size, [np.sqrt(mesh.area) / size / 3.0]])


def test_there_are_64_objects_and_no_two_are_similar() -> None:
    objects = library_meshes(dev_data("furniture"))
    shapes = {name: shape_of(mesh) for name, mesh in objects}
    assert len(objects) == len(shapes) == 64
    least = min(np.abs(shapes[a] - shapes[b]).max() for a, b in itertools.combinations(shapes, 2))
    noise = max(
        np.abs(shape_of(mesh.transformed(np.diag([2.0, 2.0, 2.0, 1.0]))) - shapes[name]).max()
        for name, mesh in objects[:3]
    )
    assert noise < 1e-6
    assert least > 0.03
