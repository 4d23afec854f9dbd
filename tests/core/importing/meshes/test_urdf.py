"""URDF robots of one rigid body: shapes and meshes at their poses, in an archive or beside the file."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.mesh_file import read_mesh_file
from regnf_core.importing.meshes import read_mesh
from regnf_core.importing.meshes.triangle_files import Geometry
from regnf_core.importing.run.opened import open_upload
from tests.core.importing.archives import assert_refused, zip_bytes

BOX = trimesh.creation.box((2.0, 4.0, 6.0)).export(file_type="stl")
MESH = '<visual><geometry><mesh filename="package://chair_description/meshes/box.stl" scale="0.1 0.1 -0.1"/></geometry>'
CHAIR = (
    '<?xml version="1.0"?>\n<!-- a chair, of <robot> parts -->\n<robot name="chair">'
    '<link name="seat"><visual><origin xyz="0 0 0.5"/><geometry><box size="0.4 0.6 0.1"/></geometry></visual>'
    '<collision><geometry><sphere radius="9"/></geometry></collision></link>'
    '<link name="back"><collision><origin rpy="0 1.5707963267948966 0"/><geometry><cylinder radius="0.1" length="0.8"/>'
    "</geometry></collision></link>"
    f'<link name="cushion">{MESH}</visual></link>'
    '<joint name="a" type="fixed"><parent link="seat"/><child link="back"/><origin xyz="1 0 2"/></joint>'
    '<joint name="b" type="fixed"><parent link="back"/><child link="cushion"/>'
    '<origin xyz="0 0 1" rpy="1.5707963267948966 0 0"/></joint></robot>'
).encode()
SIBLINGS = {"package://chair_description/meshes/box.stl": memoryview(BOX)}
ARCHIVE = [("robot/urdf/chair.urdf", CHAIR), ("robot/meshes/box.stl", BOX), ("robot/meshes/other.stl", BOX)]


def read(text: bytes = CHAIR, node: str | None = None) -> Geometry:
    assert sniff_format(text[:HEAD_BYTES]) == "urdf"
    return read_mesh("urdf", memoryview(text), SIBLINGS, node)


def box(found: Geometry) -> list[list[float]]:
    corners = found.vertices[found.faces].reshape(-1, 3)
    return [corners.min(axis=0).round(6).tolist(), corners.max(axis=0).round(6).tolist()]


@pytest.mark.parametrize(
    ("node", "extent"),
    [
        ("cushion", [[0.9, -0.3, 2.8], [1.1, 0.3, 3.2]]),  # 0.2 x 0.4 x 0.6, turned about x
        ("back", [[0.6, -0.3, 1.9], [1.4, 0.3, 3.2]]),  # a cylinder along x, with the cushion
        ("seat", [[-0.2, -0.3, 0.45], [1.4, 0.3, 3.2]]),
        (None, [[-0.2, -0.3, 0.45], [1.4, 0.3, 3.2]]),
    ],
)
def test_links_are_placed_by_their_joints_and_origins(node: str | None, extent: list[list[float]]) -> None:
    found = read(node=node)
    np.testing.assert_allclose(box(found), extent, atol=1e-3)
    assert found.assumes[0].startswith("unit: meters")


def test_a_mesh_that_its_scale_mirrors_still_looks_outward() -> None:
    found = read(node="cushion")
    assert float(trimesh.Trimesh(found.vertices, found.faces).volume) == pytest.approx(0.048)


def as_tar() -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        for name, data in ARCHIVE:
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return buffer.getvalue()


def test_an_archive_brings_the_meshes_that_the_robot_names(tmp_path: Path) -> None:
    for data in (zip_bytes(ARCHIVE), as_tar()):
        opened = open_upload(memoryview(data), tmp_path, 1 << 30)
        assert opened.name == "robot/urdf/chair.urdf"
        assert {name: bytes(content) for name, content in opened.siblings.items()} == {next(iter(SIBLINGS)): BOX}
    upload = tmp_path / "chair.zip"
    upload.write_bytes(zip_bytes(ARCHIVE))
    report = import_field(upload, tmp_path / "out", {"node": "cushion"})
    np.testing.assert_allclose(report.surface_bounds, [[0.9, -0.3, 2.8], [1.1, 0.3, 3.2]], atol=2e-3)


def test_a_robot_on_ones_own_disk_finds_its_meshes(tmp_path: Path) -> None:
    for name, data in ARCHIVE:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(data)
    found = read_mesh_file(tmp_path / "robot" / "urdf" / "chair.urdf")
    np.testing.assert_allclose(box(found), [[-0.2, -0.3, 0.45], [1.4, 0.3, 3.2]], atol=1e-3)
    (tmp_path / "robot" / "meshes" / "box.stl").unlink()
    assert_refused(lambda: read_mesh_file(tmp_path / "robot" / "urdf" / "chair.urdf"), "MESH_EXTERNAL_REFERENCE")


def test_moving_joints_are_refused_unless_a_link_is_chosen() -> None:
    moving = CHAIR.replace(b'name="b" type="fixed"', b'name="hinge" type="revolute"')
    with pytest.raises(FieldFormatError, match="moving joints, such as hinge") as caught:
        read(moving)
    assert caught.value.reason == "FORMAT_NOT_SUPPORTED"
    assert "import option node" in str(caught.value.hint)
    np.testing.assert_allclose(box(read(moving, "cushion")), [[0.9, -0.3, 2.8], [1.1, 0.3, 3.2]], atol=1e-3)
    with pytest.raises(FieldFormatError, match="the file has back, cushion, seat"):
        read(moving, "leg")


def changed(old: bytes, new: bytes) -> bytes:
    assert old in CHAIR
    return CHAIR.replace(old, new)


@pytest.mark.parametrize(
    ("reason", "text"),
    [
        ("MESH_EXTERNAL_REFERENCE", changed(b"meshes/box.stl", b"meshes/lost.stl")),
        ("FORMAT_NOT_SUPPORTED", changed(b"<link name", b'<xacro:if xmlns:xacro="http://xacro" value="1"/><link name')),
        ("MESH_INVALID", changed(b'size="0.4 0.6 0.1"', b'size="0.4 0.6"')),
        ("MESH_INVALID", changed(b'size="0.4 0.6 0.1"', b'size="0.4 0.6 -1"')),
        ("MESH_INVALID", changed(b'xyz="1 0 2"', b'xyz="1 0 two"')),
        ("MESH_INVALID", changed(b"<sphere", b"<sphere></broken")),
        ("MESH_INVALID", changed(b'<box size="0.4 0.6 0.1"/>', b'<torus size="0.4 0.6 0.1"/>')),
        ("MESH_INVALID", changed(b'<parent link="seat"/>', b'<parent link="cushion"/>')),
        ("MESH_INVALID", changed(b'<child link="cushion"/>', b'<child link="leg"/>')),
        ("MESH_INVALID", changed(b'<robot name="chair">', b'<robot name="chair"/>')),
    ],
)
def test_faulty_robots_are_refused(reason: str, text: bytes) -> None:
    assert_refused(lambda: read(text), reason)


def test_entities_are_refused() -> None:
    text = changed(b"<robot name", b'<!DOCTYPE robot [<!ENTITY a "aaaa">]><robot name')
    assert_refused(lambda: read_mesh("urdf", memoryview(text), SIBLINGS), "MESH_INVALID")


def test_a_mesh_in_a_format_that_is_not_read_is_named() -> None:
    text, scene = changed(b"box.stl", b"box.dae"), b'<?xml version="1.0"?><COLLADA xmlns="x"></COLLADA>'
    siblings = {next(iter(SIBLINGS)).replace("stl", "dae"): memoryview(scene)}
    with pytest.raises(FieldFormatError, match=r"box\.dae: a COLLADA scene; export it"):
        read_mesh("urdf", memoryview(text), siblings)
