"""Scenes of several nodes: the one that is asked for is read, and a wrong name is refused with those that exist."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from regnf_core.errors import FieldFormatError
from regnf_core.importing.meshes import read_mesh
from regnf_core.importing.meshes.scene import MAX_NODES, Nodes
from tests.core.importing.archives import assert_refused
from tests.core.importing.meshes.mesh_files import converted, exported
from tests.core.importing.meshes.test_bad_meshes import TRIANGLE, glb, triangle

ROOM: list[dict[str, Any]] = [
    {"name": "room", "children": [1, 2, 3, 6]},
    {"name": "table", "mesh": 0, "translation": [1, 0, 0]},
    {"name": "chair", "children": [4], "translation": [2, 0, 0]},
    {"name": "chair", "children": [5], "translation": [3, 0, 0]},
    {"name": "seat", "mesh": 0},
    {"name": "seat", "mesh": 0},
    {"name": "stool", "children": [7]},
    {"children": [8]},
    {"name": "seat", "mesh": 0, "translation": [4, 0, 0]},
]


def read(node: str | None, nodes: list[dict[str, Any]] = ROOM) -> list[float]:
    """How far the triangles that are read are along x, and no more than those."""
    found = read_mesh("glb", memoryview(glb(triangle(nodes=nodes), TRIANGLE)), node=node)
    corners = found.vertices[found.faces]
    np.testing.assert_allclose(corners - corners[:, 1:2] + [0, 1, 0], np.tile(np.eye(3), (len(corners), 1, 1)))
    return sorted(corners[:, 1, 0].tolist())


@pytest.mark.parametrize(
    ("node", "places"),
    [
        (None, [1, 2, 3, 4]), ("room", [1, 2, 3, 4]), ("table", [1]), ("room/table", [1]), ("/room/table/", [1]),
        ("stool", [4]), ("stool/seat", [4]), ("chair", [2]), ("chair/seat", [2]),
    ],
)  # fmt: skip
def test_a_node_is_read_with_all_that_is_part_of_it(node: str | None, places: list[float]) -> None:
    assert read(node) == places


def test_a_wrong_name_is_refused_with_the_names_that_exist() -> None:
    assert_refused(lambda: read("sofa"), "INVALID_DESCRIPTION")
    with pytest.raises(FieldFormatError, match=r"named 'sofa'; the file has chair, room, seat, stool, table$"):
        read("sofa")
    with pytest.raises(FieldFormatError, match=r"several nodes are named 'seat'.* room/chair/seat, room/stool/seat$"):
        read("seat")
    with pytest.raises(FieldFormatError, match="a stl file has no nodes"):
        read_mesh("stl", memoryview(exported("stl")), node="seat")


def test_the_report_says_which_nodes_there_are_and_which_was_read() -> None:
    data = glb(triangle(nodes=ROOM), TRIANGLE)
    told = "its nodes, to choose one by the import option node: chair, seat, stool, table"
    assert told in converted(data).why
    assert "only the node room/chair/seat, the first of 2 with this path" in converted(data, node="chair/seat").why
    assert converted(data).assumes[-2].startswith("unit: meters")
    many = [{"name": f"part {number:02}", "mesh": 0} for number in range(25)]
    scene = {"nodes": many, "scenes": [{"nodes": list(range(25))}]}
    why = converted(glb(triangle(**scene), TRIANGLE)).why
    assert any(line.endswith("part 18, part 19 and 5 more") for line in why)


def test_a_name_with_a_slash_is_found_as_it_is() -> None:
    assert read("a/b", [{"children": [1, 2]}, {"name": "a/b", "mesh": 0}, {"name": "b", "mesh": 0}]) == [0]


def test_meshes_that_no_node_places_are_chosen_by_their_own_names() -> None:
    mesh = triangle()["meshes"][0]
    data = glb(triangle(nodes=[], meshes=[mesh | {"name": "a"}, mesh | {"name": "b"}]), TRIANGLE)
    assert len(read_mesh("glb", memoryview(data), node="b").faces) == 1
    assert len(read_mesh("glb", memoryview(data)).faces) == 2


@pytest.mark.parametrize("chain", [False, True])
def test_thousands_of_nodes_are_read_side_by_side_or_one_below_the_other(chain: bool) -> None:
    count = 5_000
    nodes: list[dict[str, Any]] = [{"name": f"n{at}", "mesh": 0, "translation": [1, 0, 0]} for at in range(count)]
    for number in range(count - 1 if chain else 0):
        nodes[number]["children"] = [number + 1]
    data = glb(triangle(nodes=nodes, scenes=[{"nodes": [0] if chain else list(range(count))}]), TRIANGLE)
    found = read_mesh("glb", memoryview(data))
    places = found.vertices[found.faces][:, 1, 0]
    np.testing.assert_array_equal(np.sort(places), np.arange(1, count + 1) if chain else np.ones(count))
    deep = "/".join(f"n{at}" for at in range(count - 20, count)) if chain else "n6"
    assert len(read_mesh("glb", memoryview(data), node=deep).faces) == 1


def test_too_many_nodes_are_refused() -> None:
    nodes = Nodes()
    for _ in range(MAX_NODES):
        nodes.add("")
    assert_refused(lambda: nodes.add(""), "MESH_INVALID")
