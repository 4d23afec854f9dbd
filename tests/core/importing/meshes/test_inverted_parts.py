"""Parts of a mesh that were exported inside out: the same field as if they had not been."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from tests.core.importing.meshes.test_facing import (
    CABINET,
    FREE,
    MATTER,
    ROOM,
    TABLE,
    converted,
    distance,
    parts,
    together,
    words,
)

PROBES = np.random.default_rng(0).uniform([0.8, 0.8, -0.2], [2.2, 2.0, 1.0], size=(600, 3))


def table(inverted: tuple[int, ...] = ()) -> trimesh.Trimesh:
    """A top and four legs, each closed and on its own; these of them have their faces turned round."""
    pieces = [parts(piece) for piece in TABLE]
    for number in inverted:
        pieces[number].invert()
    return together(*pieces)


def test_any_parts_may_be_inside_out() -> None:
    expected = distance(converted(table()), PROBES)
    assert (expected < 0.0).sum() > 15
    for inverted in (*((number,) for number in range(5)), (0, 1, 2), (0, 3, 4), (1, 2, 4)):
        found = converted(table(inverted), **{"as": "object"})
        np.testing.assert_allclose(distance(found, PROBES), expected, atol=1e-6)
        assert any("flipped" in why for why in found.why)


def test_the_parts_of_another_part_are_told_when_that_one_is_right() -> None:
    outer, inner = (trimesh.creation.box(bounds=[[-size] * 3, [size] * 3]) for size in (1.0, 0.5))
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2).apply_translation([3.0, 0.0, 0.0])
    for mesh in (outer, inner):
        mesh.invert()
    found = converted(together(outer.subdivide(), inner.subdivide(), ball.subdivide().subdivide()), **{"as": "object"})
    inside = np.array([[0.0, 0.0, 0.0], [0.7, 0.0, 0.0], [3.0, 0.0, 0.0]])
    assert (distance(found, inside) < 0.0).all()


def test_a_closed_cavity_stays_free() -> None:
    shell, cavity = parts([[-1.0] * 3, [1.0] * 3]), parts([[-0.5] * 3, [0.5] * 3])
    cavity.invert()
    found = converted(together(shell, cavity))
    assert distance(found, np.array([[0.0, 0.0, 0.0]]))[0] == pytest.approx(0.5, abs=1e-6)
    assert distance(found, np.array([[0.75, 0.0, 0.0]]))[0] == pytest.approx(-0.25, abs=1e-6)
    assert not any("flipped" in why for why in found.why)


def test_things_in_a_room_may_be_inside_out() -> None:
    shell, cabinet = parts(ROOM), parts(*CABINET)
    shell.invert()
    cabinet.invert()
    found = converted(together(shell, parts(*TABLE), cabinet), **{"as": "scene"})
    assert (distance(found, FREE) > 0.0).all()
    assert (distance(found, MATTER) < 0.0).all()
    assert not words(found)


def test_a_sheet_keeps_its_faces() -> None:
    """A sheet looks at half a solid angle on both sides: neither is told."""
    sheet = parts([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    flat = trimesh.Trimesh(sheet.vertices, sheet.faces[sheet.triangles_center[:, 2] < 1e-6], process=False)
    flat.apply_translation([0.0, 0.0, -1.0])
    given = together(sheet, flat)
    found = converted(given)
    assert not any("flipped" in why for why in found.why)


def facing(mesh: trimesh.Trimesh, axis: int, sign: int) -> trimesh.Trimesh:
    """Of a mesh the faces that look along an axis or against it, as a sheet."""
    kept = mesh.faces[sign * mesh.face_normals[:, axis] > 0.9]
    return trimesh.Trimesh(mesh.vertices, kept, process=False)


def test_sheets_that_face_each_other_keep_their_faces() -> None:
    """Two boards of a shelf in a scanned room, each seen from the space between them alone."""
    shell = parts(ROOM)
    shell.invert()
    lower, upper = parts([[0.02, 1.0, 0.3], [0.6, 2.0, 0.32]]), parts([[0.02, 1.0, 0.4], [0.6, 2.0, 0.42]])
    found = converted(together(shell, parts(*TABLE), facing(lower, 2, 1), facing(upper, 2, -1)), **{"as": "scene"})
    assert not any("flipped" in why for why in found.why)
    assert distance(found, np.array([[0.3, 1.5, 0.36]]))[0] == pytest.approx(0.04, abs=1e-6)
