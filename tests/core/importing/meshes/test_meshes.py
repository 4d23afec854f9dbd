"""Meshes as uploads: our readers against trimesh's."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import torch
import trimesh

from regnf_core.fields.mesh import MeshField
from regnf_core.importing.families.converted import ConvertedField
from tests.core.importing.archives import assert_refused
from tests.core.importing.meshes.mesh_files import BALL, converted, exported
from tests.devdata import dev_data


def field_of(found: ConvertedField) -> MeshField:
    return MeshField(found.tensors["vertices"], found.tensors["faces"])


def assert_same_distance(found: ConvertedField, mesh: MeshField) -> None:
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    low, high = mesh.bounds.float()
    points = (low + high) / 2 + points * (high - low)
    expected = mesh.signed_distance(points)
    torch.testing.assert_close(
        field_of(found).signed_distance(points), expected, rtol=0, atol=2e-6 * float(expected.abs().max())
    )


@pytest.mark.parametrize(
    "data",
    [
        *(exported("ply"), exported("ply", encoding="ascii"), exported("stl"), exported("stl_ascii"), exported("obj")),
        exported("glb"),
    ],
    ids=["ply", "ply text", "stl", "stl text", "obj", "glb"],
)
def test_every_format_gives_the_mesh_that_trimesh_wrote(data: bytes) -> None:
    found = converted(data)
    assert_same_distance(found, MeshField(BALL.vertices, BALL.faces))
    assert len(found.tensors["vertices"]) == len(BALL.vertices)  # the seams of loose triangles are welded
    assert (found.family, found.why[1], found.warnings) == ("mesh", "watertight", ())
    low, high = np.array(found.description["bounds"])
    np.testing.assert_allclose([low, high], [[-0.5 - 0.05 * 3**0.5] * 3, [0.5 + 0.05 * 3**0.5] * 3], atol=0.01)


@pytest.mark.parametrize("name", ["outdoor_folding_chair", "vintage_electric_kettle", "ycb_004_sugar_box"])
def test_real_glb_files_agree_with_trimesh(name: str) -> None:
    path = dev_data("furniture", f"{name}.glb")
    mesh = trimesh.load_scene(path, process=False).to_mesh()
    assert_same_distance(converted(path.read_bytes()), MeshField(mesh.vertices, mesh.faces))


def test_a_scene_graph_is_merged_at_its_poses() -> None:
    scene = trimesh.Scene()
    turned = trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, 3.0], [0.1, 0.2, 0.3])
    mirrored = np.diag([-2.0, 1.0, 1.0, 1.0])
    scene.add_geometry(trimesh.creation.box((0.2, 0.4, 0.6)), node_name="a", transform=turned)
    scene.add_geometry(trimesh.creation.box((0.3, 0.2, 0.1)), node_name="b", transform=mirrored, parent_node_name="a")
    data = trimesh.exchange.gltf.export_glb(scene)  # type: ignore[no-untyped-call]
    expected = trimesh.load_scene(trimesh.util.wrap_as_stream(data), file_type="glb").to_mesh()
    assert_same_distance(converted(data), MeshField(expected.vertices, expected.faces))


def test_binary_ply_with_everything_else_in_it() -> None:
    """Big-endian, polygons of three, four and five corners, colors, another element before and one behind."""
    header = (
        "ply\r\nformat binary_big_endian 1.0\r\nelement note 2\r\nproperty list uchar short words\r\n"
        "element vertex 8\r\nproperty uchar red\r\nproperty double x\r\nproperty double y\r\nproperty double z\r\n"
        "element face 6\r\nproperty list ushort uint vertex_index\r\nproperty float quality\r\n"
        "element edge 1\r\nproperty int a\r\nend_header\r\n"
    )
    corners = [(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7), (1, 7, 3)]
    body = struct.pack(">BhhB", 2, 5, 6, 0)
    body += b"".join(struct.pack(">B3d", 7, *corner) for corner in corners)
    body += b"".join(struct.pack(f">H{len(f)}If", len(f), *f, 0.5) for f in faces) + struct.pack(">i", 3)
    found = converted((header.replace("face 6", "face 7")).encode() + body)
    box = trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1]])
    assert_same_distance(found, MeshField(box.vertices, box.faces))
    assert found.why[1] == "watertight"


def test_obj_counts_from_either_end_and_passes_over_the_rest() -> None:
    text = (
        "# a tetrahedron\nmtllib colors.mtl\nv 0 0 0 1.0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nusemtl red\n"
        "v 0 0 1\nf 1/1 3/1/1 2//1\nf -4 -3 \\\n -1\nf 2 3 4\nf 1 4 3\n"
    )
    found = converted(text.encode())
    assert found.why[1:] == ("watertight", "ignored: materials in another file")
    inside, outside = field_of(found).signed_distance(torch.tensor([[0.1, 0.1, 0.1], [-0.5, 0.2, 0.2]])).tolist()
    assert (inside, outside) == pytest.approx((-0.1, 0.5), abs=1e-6)


def test_holes_are_reported_and_have_an_inside_nonetheless() -> None:
    found = converted(trimesh.Trimesh(BALL.vertices, BALL.faces[16:], process=False).export(file_type="ply"))
    assert found.why[1].startswith("not watertight, ")
    assert field_of(found).signed_distance(torch.zeros(1, 3)).item() < -0.4


def test_what_is_said_goes_before() -> None:
    found = converted(exported("stl"), world_scale=0.001, sign=-1, label="ball", up_axis="z")
    assert {name: found.description[name] for name in ("world_scale", "sign", "label", "up_axis")} == {
        "world_scale": 0.001,
        "sign": -1,
        "label": "ball",
        "up_axis": "z",
    }
    assert found.description["bounds"][1][0] == pytest.approx(0.001 * (0.5 + 0.05 * 3**0.5), rel=0.02)
    assert_refused(lambda: converted(exported("stl"), level_mask=3), "INVALID_DESCRIPTION")
    assert_refused(lambda: converted(exported("stl"), family="neus"), "FAMILY_NOT_SUPPORTED")
