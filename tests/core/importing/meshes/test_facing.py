"""Which side of a mesh is free: objects from outside, rooms from within, whole and with parts missing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.triangles import mesh_field
from regnf_core.importing.meshes.triangle_files import Geometry
from regnf_core.importing.upload_description import UploadDescription
from tests.core.importing.meshes.mesh_files import field_of

ROOM = np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 2.5]])
TABLE = [([1.0, 1.0, 0.7], [2.0, 1.8, 0.76])] + [
    ([x, y, 0.0], [x + 0.08, y + 0.08, 0.7]) for x in (1.0, 1.92) for y in (1.0, 1.72)
]
CABINET = [([3.4, 0.5, 0.001], [3.98, 1.7, 1.9])]
FREE = np.array([[1.5, 1.4, 0.35], [1.5, 1.4, 1.0], [0.3, 2.5, 1.5], [3.0, 1.0, 0.2], [2.5, 2.5, 2.0]])
MATTER = np.array([[1.5, 1.4, 0.73], [1.04, 1.04, 0.4], [3.7, 1.0, 1.0]])
BEHIND_WALLS = np.array([[-0.1, 1.5, 0.4], [2.0, 3.1, 0.4], [2.0, 1.5, -0.1]])


def together(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return trimesh.Trimesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces), process=False)


def parts(*boxes: Any) -> trimesh.Trimesh:
    made = [trimesh.creation.box(bounds=bounds) for bounds in boxes]
    for _ in range(3):
        made = [mesh.subdivide() for mesh in made]
    return together(*made)


def scanned_room(*things: Any) -> trimesh.Trimesh:
    """A room's walls facing inward, and things in it that face the room."""
    shell = parts(ROOM)
    shell.invert()
    return together(shell, parts(*things)) if things else shell


def converted(mesh: trimesh.Trimesh, **said: Any) -> ConvertedField:
    geometry = Geometry(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64))
    return mesh_field(geometry, "a file", UploadDescription.from_dict(said))


def distance(found: ConvertedField, points: NDArray[np.float64]) -> NDArray[np.float32]:
    values: NDArray[np.float32] = field_of(found).signed_distance(torch.from_numpy(points)).numpy()
    return values


def without(mesh: trimesh.Trimesh, gone: Callable[[NDArray[np.float64]], NDArray[np.bool_]]) -> trimesh.Trimesh:
    kept = mesh.faces[~gone(mesh.triangles_center)]
    return trimesh.Trimesh(mesh.vertices, kept, process=False)


def words(found: ConvertedField) -> list[str]:
    return [warning.partition(":")[0] for warning in found.warnings]


HOLES = np.array([[2.0, 0.0, 1.5], [0.0, 1.5, 1.0], [3.0, 2.0, 2.5], [1.2, 3.0, 2.0], [3.0, 2.4, 0.0]])
FURNISHED = scanned_room(*TABLE, *CABINET)


@pytest.mark.parametrize(
    "room",
    [
        FURNISHED,
        without(FURNISHED, lambda c: c[:, 2] > 2.49),
        without(FURNISHED, lambda c: c[:, 0] > 3.99),
        without(FURNISHED, lambda c: (np.linalg.norm(c[:, None] - HOLES, axis=2) < 0.3).any(1)),
        together(FURNISHED, without(FURNISHED, lambda c: c[:, 0] > 2.0)),
    ],
    ids=["whole", "no ceiling", "a wall missing", "with holes", "half of it twice"],
)
@pytest.mark.parametrize("said", [{}, {"as": "scene"}], ids=["by evidence", "as scene"])
def test_a_room_seen_from_within_is_not_turned_round(room: trimesh.Trimesh, said: dict[str, str]) -> None:
    found = converted(room, **said)
    assert words(found) == ([] if said else ["SCENE_ASSUMED"])
    assert (distance(found, FREE) > 0).all()
    assert (distance(found, MATTER) < 0).all()
    assert (distance(found, BEHIND_WALLS) < 0).all()


def test_a_room_s_distances_are_those_of_its_surface() -> None:
    rng = np.random.default_rng(5)
    points = ROOM[0] + (ROOM[1] - ROOM[0]) * rng.random((300, 3))
    lows, highs = (np.array([box[i] for box in [*TABLE, *CABINET]]) for i in (0, 1))
    beyond = np.maximum(lows - points[:, None], points[:, None] - highs)  # (N, boxes, 3)
    to_boxes = np.linalg.norm(np.maximum(beyond, 0.0), axis=2) + np.minimum(beyond.max(axis=2), 0.0)
    to_walls = np.minimum(points - ROOM[0], ROOM[1] - points).min(axis=1)
    expected = np.minimum(to_boxes.min(axis=1), to_walls)
    free = expected > 0
    assert 0.5 < free.mean() < 1.0
    np.testing.assert_allclose(distance(converted(FURNISHED), points)[free], expected[free], rtol=0, atol=1e-5)


@pytest.mark.parametrize("sheets", ["floor and one wall", "floor"])
def test_open_scans_are_free_before_their_faces_and_matter_behind(sheets: str) -> None:
    walls = (lambda c: (c[:, 0] > 0.01) & (c[:, 2] > 0.01)) if sheets != "floor" else (lambda c: c[:, 2] > 0.01)
    shell = scanned_room()
    scan = together(without(shell, walls), without(parts(*TABLE), lambda c: c[:, 2] < 0.01))
    found = converted(scan, **{"as": "scene"})
    assert words(found) == []
    near = np.array([[1.5, 1.4, 0.3], [1.5, 1.4, 1.0], [0.4, 2.5, 0.3], [3.0, 2.0, 0.1]])
    assert (distance(found, near) > 0).all()
    assert (distance(found, MATTER[:2]) < 0).all()
    assert (distance(found, np.array([[2.0, 1.5, -0.05], [1.0, 0.5, -0.1]])) < 0).all()


@pytest.mark.parametrize(
    "mesh",
    [trimesh.creation.icosphere(2), parts(*TABLE), trimesh.creation.torus(1.0, 0.3), parts(([0, 0, 0], [2, 1, 1]))],
    ids=["ball", "table", "torus", "box"],
)
def test_objects_with_their_faces_turned_round_are_turned_back(mesh: trimesh.Trimesh) -> None:
    inverted = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
    points = mesh.bounds[0] + np.ptp(mesh.bounds, axis=0) * np.random.default_rng(0).random((200, 3))
    expected = distance(converted(mesh), points)
    for said in ({}, {"as": "object"}):
        found = converted(inverted, **said)
        assert words(found) == ["MESH_INSIDE_OUT"]
        np.testing.assert_allclose(distance(found, points), expected, atol=1e-5)


def test_what_is_asked_for_decides() -> None:
    assert words(converted(FURNISHED, **{"as": "object"})) == ["MESH_INSIDE_OUT"]
    empty = scanned_room()
    assert words(converted(empty)) == ["MESH_INSIDE_OUT"]  # nothing stands in it: a box turned round
    assert (distance(converted(empty, **{"as": "scene"}), FREE) > 0).all()


def test_one_small_thing_makes_a_shell_a_room_but_no_crate_that_was_turned_round() -> None:
    cup = ([1.0, 1.0, 0.001], [1.1, 1.1, 0.1])
    assert words(converted(scanned_room(cup))) == ["SCENE_ASSUMED"]
    filled = scanned_room()
    inner = parts(cup)
    inner.invert()
    assert words(converted(together(filled, inner))) == ["MESH_INSIDE_OUT"]


@pytest.mark.parametrize("said", [{}, {"as": "scene"}, {"as": "object"}], ids=["unsaid", "scene", "object"])
def test_solids_that_face_outward_are_left_as_they_are(said: dict[str, str]) -> None:
    floor = parts(([0, 0, -0.1], [4, 3, 0.0]), *TABLE, *CABINET)
    found = converted(floor, **said)
    assert (words(found), found.description["inside_above"]) == ([], 0.5)
    assert (distance(found, FREE) > 0).all()
    assert (distance(found, MATTER) < 0).all()


def test_a_shell_that_faces_outward_round_a_scene_is_turned_to_face_it() -> None:
    room = parts(ROOM, *TABLE, *CABINET)
    found = converted(room, **{"as": "scene"})
    assert "its faces were flipped towards it" in " ".join(found.why)
    assert (distance(found, FREE) > 0).all()
    assert (distance(found, MATTER) < 0).all()


def test_an_object_with_a_third_missing_keeps_its_inside() -> None:
    ball = trimesh.creation.icosphere(3)
    found = converted(without(ball, lambda c: c[:, 2] > 0.33))
    assert "parts of the surface are missing" in " ".join(found.why)
    directions = ball.vertices[ball.vertices[:, 2] < 0.2]
    assert (distance(found, 0.97 * directions) < 0).all()
    assert (distance(found, 1.03 * directions) > 0).all()


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_faces_that_are_turned_among_their_neighbors_are_turned_back(share: float) -> None:
    ball = trimesh.creation.icosphere(3)
    turned = np.random.default_rng(4).random(len(ball.faces)) < share
    faces = np.where(turned[:, None], ball.faces[:, ::-1], ball.faces)
    found = converted(trimesh.Trimesh(ball.vertices, faces, process=False))
    assert any("was flipped to match" in why for why in found.why)
    np.testing.assert_array_equal(found.tensors["faces"], converted(ball).tensors["faces"])
