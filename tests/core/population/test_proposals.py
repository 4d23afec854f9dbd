"""The boundary of a scene, and boxes around its things."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from regnf_core.fields.mesh import MeshField
from regnf_core.geometry.box import OrientedBox
from regnf_core.population.proposals import SceneSurface, box_around, pieces, proposals, scene_surface
from tests.core.population.rooms import bracket, chair, pose, room, table

THINGS = {
    "chair": (chair(), pose(0.9, -0.7, 0.0, 30.0)),
    "table": (table(), pose(-0.5, 0.3, 0.0, 75.0)),
    "bracket": (bracket(), pose(-0.6, 0.25, 0.72, 10.0)),
}
SCENE = room(list(THINGS.values()))


@pytest.fixture(scope="module")
def surface() -> SceneSurface:
    return scene_surface(SCENE)


def overlap(box: OrientedBox, points: np.ndarray) -> float:
    """Intersection over union of a box and the extent of points along its axes."""
    local = box.to_local(torch.from_numpy(points)).numpy()
    low, high, half = local.min(0), local.max(0), box.size.numpy() / 2
    both = np.clip(np.minimum(high, half) - np.maximum(low, -half), 0, None).prod()
    return float(both / ((high - low).prod() + box.size.numpy().prod() - both))


def test_floor_and_walls_are_the_boundary_and_a_table_top_is_not(surface: SceneSurface) -> None:
    found = sorted((tuple(np.round(one.normal, 2) + 0.0), round(one.offset, 2)) for one in surface.boundary)
    assert found == [((0.0, -1.0, 0.0), -1.5), ((0.0, 0.0, 1.0), 0.0), ((1.0, 0.0, 0.0), -1.8)]


def test_samples_lie_on_the_surface_off_the_boundary(surface: SceneSurface) -> None:
    distance, gradient = SCENE.signed_distance_and_gradient(torch.from_numpy(surface.points))
    assert float(distance.abs().max()) < 0.35 * surface.spacing
    assert min(float(one.height(surface.points).min()) for one in surface.boundary) >= surface.cut
    alike = (gradient.double().numpy() * surface.normals).sum(1)
    assert np.quantile(alike, 0.02) > 0.9


@pytest.mark.parametrize("name", THINGS)
def test_each_thing_has_a_box_of_its_own(surface: SceneSurface, name: str) -> None:
    mesh, T = THINGS[name]
    points = np.asarray(mesh.vertices) @ T[:3, :3].T + T[:3, 3]
    found = proposals(surface, np.ones(len(surface), bool), 40)
    assert max(overlap(one.box, points) for one in found) > 0.6  # a search finds a thing in such a box


def test_what_is_explained_is_not_proposed_again(surface: SceneSurface) -> None:
    free = np.ones(len(surface), bool)
    first = proposals(surface, free, 40)
    assert proposals(surface, free, 40, [one.samples for one in first]) == []
    free[:] = False
    assert proposals(surface, free, 40) == []
    assert list(pieces(surface, free)) == []


def test_the_pieces_are_what_stands_apart(surface: SceneSurface) -> None:
    whole = list(pieces(surface, np.ones(len(surface), bool)))
    sizes = [len(one.samples) for one in whole]
    assert sizes == sorted(sizes, reverse=True)
    assert len(whole) == 2  # the chair, and the table with what is on it


def test_a_box_is_the_smallest_along_the_direction_up() -> None:
    random = np.random.default_rng(0)
    corners = random.uniform(-1, 1, (4000, 3)) * [0.5, 0.2, 0.3]
    T = pose(1.0, 2.0, 3.0, 33.0)
    box = box_around(corners @ T[:3, :3].T + T[:3, 3], np.array([0.0, 0.0, 1.0]), 0.0)
    assert sorted(box.size.tolist()) == pytest.approx([0.4, 0.6, 1.0], abs=0.02)
    assert np.allclose(box.center.numpy(), [1, 2, 3], atol=0.01)
    assert abs(box.rotation[2, 2]) == pytest.approx(1.0)


def test_the_scene_may_be_in_any_frame_and_unit() -> None:
    T = np.eye(4)
    T[:3, :3] = 250.0 * pose(0, 0, 0, 40.0)[:3, :3] @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    T[:3, 3] = [5000.0, -300.0, 20.0]
    moved: MeshField = SCENE.transformed(T)
    found = scene_surface(moved)
    normals = np.array([one.normal for one in found.boundary])
    assert len(found.boundary) == 3
    assert np.abs(normals @ T[:3, 2] / 250.0).max() == pytest.approx(1.0, abs=1e-3)
