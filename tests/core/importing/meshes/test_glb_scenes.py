"""glTF scenes: instances, skins, morph targets, sparse numbers, and extensions that are not applied."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from regnf_core.importing.meshes import read_mesh
from tests.core.importing.archives import assert_refused
from tests.core.importing.meshes.mesh_files import converted
from tests.core.importing.meshes.test_bad_meshes import POSITION, TRIANGLE, glb, triangle


def document(arrays: list[tuple[np.ndarray, str]], **changes: Any) -> bytes:
    """The triangle of ``triangle()``, and more arrays from accessor 1 on."""
    kinds = {"float32": 5126, "uint8": 5121, "int16": 5122, "uint16": 5123}
    parts, views, accessors = [TRIANGLE], [{"buffer": 0, "byteLength": 36}], [POSITION]
    for array, kind in arrays:
        start, data = sum(map(len, parts)), array.tobytes()
        parts.append(data + b"\0" * (-len(data) % 4))
        normalized = array.dtype.name == "int16"
        accessors.append(
            {"bufferView": len(views), "componentType": kinds[array.dtype.name], "count": len(array), "type": kind}
            | ({"normalized": True} if normalized else {})
        )
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(data)})
    binary = b"".join(parts)
    said = triangle(accessors=accessors, bufferViews=views, buffers=[{"byteLength": len(binary)}])
    return glb(said | changes, binary)


def places(data: bytes) -> np.ndarray:
    """(F, 3, 3): the corners of the triangles."""
    found = read_mesh("glb", memoryview(data))
    return found.vertices[found.faces]


def test_instances_stand_where_they_are_said_to() -> None:
    shift = np.array([[0, 0, 0], [5, 0, 0], [0, 7, 0]], "<f4")
    turn = np.array([[0, 0, 0, 1], [0, 0, 1, 0], [0, 0, 0.70710678, 0.70710678]]) * 32767
    scale = np.array([[1, 1, 1], [2, 2, 2], [1, 3, 1]], "<f4")
    attributes = {"TRANSLATION": 1, "ROTATION": 2, "SCALE": 3}
    node = {"mesh": 0, "translation": [0, 0, 10], "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}}
    used = {"extensionsUsed": ["EXT_mesh_gpu_instancing"], "extensionsRequired": ["EXT_mesh_gpu_instancing"]}
    data = document([(shift, "VEC3"), (turn.round().astype("<i2"), "VEC4"), (scale, "VEC3")], nodes=[node], **used)
    found = places(data)
    corner = np.eye(3)
    half = corner * [-2, -2, 2] + [5, 0, 10]  # half a turn about z, twice as large
    quarter = np.stack([-3 * corner[:, 1], corner[:, 0] + 7, corner[:, 2] + 10], axis=1)
    np.testing.assert_allclose(found, np.stack([corner + np.array([0, 0, 10]), half, quarter]), atol=2e-4)
    assert converted(data).warnings == ()


def test_instances_by_place_alone_multiply_below_their_node() -> None:
    count = np.zeros((4, 3), "<f4")
    count[:, 0] = np.arange(4)
    said = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 1}}}
    nodes = [{"children": [1], "scale": [2, 2, 2]}, {"mesh": 0, "extensions": said}]
    found = places(document([(count, "VEC3")], nodes=nodes))
    np.testing.assert_allclose(found[:, :, 0].min(axis=1), [0.0, 2.0, 4.0, 6.0])


def test_a_skin_stands_at_rest_and_its_node_says_nothing() -> None:
    joints = np.array([[0, 1, 0, 0]] * 3, "u1")
    weights = np.array([[1, 0, 0, 0], [0.5, 0.5, 0, 0], [0, 2, 0, 0]], "<f4")  # the last is normalized
    binds = np.stack([np.eye(4), np.eye(4)]).astype("<f4").reshape(2, 16)
    binds[1, 12:15] = [0, 0, -1]
    attributes = {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}
    nodes = [
        {"mesh": 0, "skin": 0, "translation": [100, 0, 0], "scale": [9, 9, 9]},
        {"translation": [1, 0, 0]},
        {"translation": [0, 4, 0]},
    ]
    data = document(
        [(joints, "VEC4"), (weights, "VEC4"), (binds, "MAT4")],
        nodes=nodes,
        scenes=[{"nodes": [0, 1, 2]}],
        meshes=[{"primitives": [{"attributes": attributes}]}],
        skins=[{"joints": [1, 2], "inverseBindMatrices": 3}],
    )
    np.testing.assert_allclose(places(data)[0], [[2, 0, 0], [0.5, 3, -0.5], [0, 4, 0]], atol=1e-6)


@pytest.mark.parametrize(("of_node", "expected"), [(None, 0.5), ([2.0], 2.0), ([0.0], 0.0)])
def test_morph_targets_have_their_default_weights(of_node: list[float] | None, expected: float) -> None:
    moved = np.full((3, 3), 2.0, "<f4")
    mesh = {"primitives": [{"attributes": {"POSITION": 0}, "targets": [{"POSITION": 1}]}], "weights": [0.5]}
    node = {"mesh": 0} | ({} if of_node is None else {"weights": of_node})
    found = places(document([(moved, "VEC3")], meshes=[mesh], nodes=[node]))
    np.testing.assert_allclose(found[0], np.eye(3) + 2.0 * expected)


def test_sparse_numbers_are_put_in_their_places() -> None:
    index, value = np.array([[2]], "<u2"), np.array([[7, 8, 9]], "<f4")
    sparse = {"count": 1, "indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 2}}
    whole = document([(index, "SCALAR"), (value, "VEC3")])
    views = [
        {"buffer": 0, "byteLength": 36},
        {"buffer": 0, "byteOffset": 36, "byteLength": 2},
        {"buffer": 0, "byteOffset": 40, "byteLength": 12},
    ]
    said = triangle(accessors=[POSITION | {"sparse": sparse}], bufferViews=views, buffers=[{"byteLength": 52}])
    binary = whole[-52:]
    np.testing.assert_allclose(places(glb(said, binary))[0], [[1, 0, 0], [0, 1, 0], [7, 8, 9]])


def test_invisible_nodes_are_left_out() -> None:
    hidden = {"mesh": 0, "translation": [5, 0, 0], "extensions": {"KHR_node_visibility": {"visible": False}}}
    data = glb(triangle(nodes=[{"mesh": 0}, hidden], scenes=[{"nodes": [0, 1]}]), TRIANGLE)
    assert len(places(data)) == 1


def test_every_extension_that_may_change_the_shape_is_said() -> None:
    used = ["KHR_materials_unlit", "KHR_texture_transform", "ACME_displacement", "EXT_mesh_gpu_instancing"]
    (warning,) = (one for one in converted(glb(triangle(extensionsUsed=used), TRIANGLE)).warnings if "GEOM" in one)
    assert warning == "GEOMETRY_IGNORED: not read: extension ACME_displacement"
    assert len(places(glb(triangle(extensionsRequired=["KHR_xmp_json_ld"]), TRIANGLE))) == 1
    with pytest.raises(Exception, match="needs the extension ACME_displacement, which is not read"):
        converted(glb(triangle(extensionsRequired=["ACME_displacement"]), TRIANGLE))


def test_faulty_instances_and_skins_are_refused() -> None:
    said = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 1, "SCALE": 2}}}
    shift, scale = np.zeros((2, 3), "<f4"), np.ones((3, 3), "<f4")
    uneven = document([(shift, "VEC3"), (scale, "VEC3")], nodes=[{"mesh": 0, "extensions": said}])
    skin = document([], nodes=[{"mesh": 0, "skin": 0}], skins=[{"joints": [7]}])
    for data in (uneven, skin):
        assert_refused(lambda data=data: converted(data), "MESH_INVALID")
