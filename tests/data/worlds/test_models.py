"""What can be seen of a model from outside."""

from __future__ import annotations

import numpy as np

from benchmarks.random_worlds.mesh import Array, Mesh, box, together
from benchmarks.random_worlds.models import Model


def seen(mesh: Mesh) -> Array:
    return Model("thing", mesh).surface


def test_what_lies_within_another_part_is_not_seen() -> None:
    outer, inner = box([-1.0] * 3, [1.0] * 3), box([-0.5] * 3, [0.5] * 3)
    found = seen(together(outer, inner))
    assert len(found) > 1_000
    assert (np.abs(found).max(axis=1) > 0.999).all()


def test_parts_that_are_inside_out_and_sheets_are_seen() -> None:
    solid = box([-1.0] * 3, [1.0] * 3)
    inverted = Mesh(solid.shifted(3.0, 0.0, 0.0).vertices, solid.faces[:, ::-1])
    sheet = Mesh(np.array([[5.0, 0.0, 0.0], [7.0, 0.0, 0.0], [5.0, 2.0, 0.0]]), np.array([[0, 1, 2]]))
    found = seen(together(solid, inverted, sheet))
    areas = np.array(
        [(found[:, 0] < 1.5).sum(), ((found[:, 0] > 1.5) & (found[:, 0] < 4.5)).sum(), (found[:, 0] > 4.5).sum()]
    )
    np.testing.assert_allclose(areas / areas.sum(), np.array([24.0, 24.0, 2.0]) / 50.0, atol=0.03)


def test_a_cup_is_seen_within() -> None:
    walls = [box([-1.0, -1.0, 0.0], [1.0, -0.9, 2.0]), box([-1.0, 0.9, 0.0], [1.0, 1.0, 2.0])]
    walls += [box([-1.0, -0.9, 0.0], [-0.9, 0.9, 2.0]), box([0.9, -0.9, 0.0], [1.0, 0.9, 2.0])]
    found = seen(together(*walls, box([-0.9, -0.9, 0.0], [0.9, 0.9, 0.1])))
    within = (np.abs(found[:, :2]) < 0.95).all(axis=1) & (found[:, 2] > 0.05) & (found[:, 2] < 1.99)
    assert within.mean() > 0.3
