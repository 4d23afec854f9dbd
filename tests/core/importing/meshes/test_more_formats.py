"""glTF in parts, strips, PCD and plain points: sound files, and files that lie."""

from __future__ import annotations

import base64
import json
import math
import struct
from functools import partial
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.importing.families.mesh import convert_mesh
from regnf_core.importing.meshes import read_mesh
from regnf_core.importing.meshes.point_files import unpack_lzf
from regnf_core.importing.upload_description import UploadDescription
from tests.core.importing.archives import assert_refused, zip_bytes
from tests.core.importing.meshes.mesh_files import (
    BALL,
    PLY_TRIANGLE,
    converted,
    exported,
    glb_parts,
    literal_lzf,
    pcd,
    strips_ply,
)
from tests.core.importing.meshes.test_point_clouds import directions

AROUND = directions(400)


def volume(data: bytes, **options: Any) -> tuple[float, np.ndarray[Any, Any]]:
    """Of the mesh in a file: its volume and its center."""
    format_ = sniff_format(data[:HEAD_BYTES])
    found = read_mesh(str(format_), memoryview(data), **options)
    mesh = trimesh.Trimesh(found.vertices, found.faces, process=True)
    assert mesh.is_watertight
    return float(mesh.volume), np.asarray(mesh.center_mass)


@pytest.mark.parametrize("binary", [False, True])
def test_strips_are_turned_one_by_one(binary: bool) -> None:
    assert volume(strips_ply(binary))[0] == pytest.approx(1 / 6, rel=1e-6)


def test_gltf_in_parts_needs_its_parts() -> None:
    document, parts = glb_parts()
    assert sniff_format(document[:HEAD_BYTES]) == "gltf"
    assert volume(document, siblings=parts)[0] == pytest.approx(BALL.volume, rel=1e-5)
    assert_refused(lambda: converted(document), "MESH_EXTERNAL_REFERENCE")
    whole = json.loads(document)
    for buffer in whole["buffers"]:
        data = base64.b64encode(parts[buffer["uri"]]).decode()
        buffer["uri"] = f"data:application/octet-stream;base64,{data}"
    assert volume(json.dumps(whole).encode())[0] == pytest.approx(BALL.volume, rel=1e-5)


DATA = "data:;base64,"
URIS = {
    "MESH_EXTERNAL_REFERENCE": ["../model.bin", "/etc/passwd", "http://example.org/a.bin", "%2e%2e/x"],
    "MESH_INVALID": [7, None, DATA + "AAAA", DATA + "!!!!", DATA + "A" * (1 << 20)],
}


@pytest.mark.parametrize("reason", URIS)
def test_gltf_never_reaches_for_a_file_and_its_data_is_what_it_claims(reason: str) -> None:
    for uri in URIS[reason]:
        document = json.loads(glb_parts()[0])
        document["buffers"] = [buffer | {"uri": uri} for buffer in document["buffers"]]
        text = json.dumps(document).encode()
        assert_refused(partial(converted, text), reason)


def points_text(normals: bool, count: bool = False, separator: str = " ") -> bytes:
    rows = np.hstack([0.5 * AROUND, AROUND]) if normals else 0.5 * AROUND
    lines = [separator.join(f"{value:.6f}" for value in row) for row in rows]
    return "\n".join([str(len(rows))] * count + lines).encode() + b"\n"


@pytest.mark.parametrize(
    "data",
    [
        *(pcd(0.5 * AROUND, AROUND, data) for data in ("ascii", "binary", "binary_compressed")),
        points_text(normals=True),
        points_text(normals=True, count=True),
        points_text(normals=True, separator=", "),
    ],
    ids=["ascii", "binary", "compressed", "xyz", "pts", "commas"],
)
def test_clouds_give_the_points_and_normals_they_were_written_from(data: bytes) -> None:
    format_ = sniff_format(data[:HEAD_BYTES])
    assert format_ in ("pcd", "xyz")
    found = read_mesh(format_, memoryview(data))
    np.testing.assert_allclose(found.vertices, 0.5 * AROUND, atol=1e-6)
    assert found.normals is not None
    np.testing.assert_allclose(found.normals, AROUND, atol=1e-6)


POSES = [(np.hstack([Rotation.from_rotvec(one).as_matrix(), 9.0 * one[:, None]]), one) for one in AROUND]
KITTI = "".join(" ".join(f"{number:.6f}" for number in pose.ravel()) + "\n" for pose, _ in POSES).encode()
TUM = "".join(
    " ".join(f"{number:.6f}" for number in (0.1 * n, *one, *Rotation.from_rotvec(one).as_quat())) + "\n"
    for n, (_, one) in enumerate(POSES)
).encode()
BINARY, ASCII = pcd(AROUND, AROUND, "binary"), pcd(AROUND, AROUND, "ascii")
CLOUDS = {
    "MESH_INVALID": [
        BINARY.replace(b"POINTS 400", b"POINTS 99999999"),
        *(BINARY[:-1], ASCII[:-300], pcd(AROUND, AROUND, "binary_compressed")[:-1]),
        ASCII.replace(b"0.7 -", b"0.7 -" + b"x" * 20000),
        *(BINARY.replace(b"POINTS 400", b"POINTS -400"), BINARY.replace(b"COUNT 1", b"COUNT 9")),
        *(BINARY.replace(b"TYPE F", b"TYPE Q"), BINARY.replace(b"SIZE 4", b"SIZE 3")),
        *(BINARY.replace(b"FIELDS x y", b"FIELDS x x"), BINARY.replace(b"DATA binary", b"DATA zipped")),
        *(points_text(normals=True) + row for row in (b"1 2\n" * 9, b"1 2 six 4 5 6\n" * 9)),
        *(KITTI, TUM),
    ],
}


@pytest.mark.parametrize("reason", CLOUDS)
def test_faulty_clouds(reason: str) -> None:
    for data in CLOUDS[reason]:
        format_ = "pcd" if b"PCD" in data[:40] else "xyz"
        assert_refused(
            lambda kind=format_, data=data: convert_mesh(kind, memoryview(data), UploadDescription()), reason
        )


def test_compressed_points_unpack_to_exactly_what_is_claimed() -> None:
    raw = b"abc" * 7 + b"\0" * 500 + bytes(range(256))
    packed = literal_lzf(raw)
    assert bytes(unpack_lzf(memoryview(packed), len(raw))) == raw
    assert bytes(unpack_lzf(memoryview(b"\x02abc\xe0\x09\x02"), 21)) == b"abc" * 7  # a copy that overlaps itself
    for faulty, size in (
        *((packed, len(raw) - 1), (packed, len(raw) + 1), (packed[:-1], len(raw)), (b"\x20\x05", 3), (b"\xe0", 9)),
        *((b"\x00", 1), (b"\x00a", 1 << 40)),
    ):
        assert_refused(partial(unpack_lzf, memoryview(faulty), size), "MESH_INVALID")


@pytest.mark.parametrize("kind", ["obj", "ply", "stl_ascii"])
@pytest.mark.parametrize("before", [b"\xef\xbb\xbf", b" \r\n\n"])
def test_text_may_begin_with_a_mark_and_blank_lines(kind: str, before: bytes) -> None:
    plain = exported(kind, **({"encoding": "ascii"} if kind == "ply" else {}))
    marked = converted(before + plain)
    np.testing.assert_array_equal(marked.tensors["vertices"], converted(plain).tensors["vertices"])


SHEET = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
STL = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n"


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        *(("# File exported by Houdini\ng\n" + SHEET, "obj"), ("o\ns off\nusemtl\n" + SHEET, "obj")),
        *(("# licence\n" + "# words\n" * 200 + SHEET, "obj"), ("\ufeff" + SHEET, "obj")),
        ("\ufeff# begun\r\n" + SHEET.replace("\n", "\r\n"), "obj"),
        *(("solid " + "/" * 900 + " vertex 1 2 3\n" + STL, "stl"), ("\n  SOLID THING\n" + STL.upper(), "stl")),
        *(("\ufeffsolid thing\n" + STL, "stl"), ("# by hand\nsolid a\n" + STL + "solid vertex 9\n" + STL[:0], "stl")),
        *(
            ("written by a program\n" + SHEET, "obj"),
            ("; a sign of comments\n" + SHEET, "obj"),
            (SHEET + "\0\x1a", "obj"),
        ),
        ("vt -nan(ind) 1.#QNAN\n" + SHEET.replace("f 1 3 2", "f 1 \\ \n3.0 2 # three"), "obj"),
        ("g a\\\n" + SHEET.replace("v 1 0 0", "v 1.0D+00 0 0").replace("f ", "fo "), "obj"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_unusual_beginnings_are_recognized(text: str, kind: str, encoding: str) -> None:
    data = text.encode(encoding)
    assert sniff_format(data[:HEAD_BYTES]) == kind
    assert len(read_mesh(kind, memoryview(data)).faces) == (4 if kind == "obj" else 1)


@pytest.mark.parametrize(
    ("old", "new", "ignored"),
    [
        ("f 1 3 2\n", "f 1 3 2\nf 1 2\n", "1 faces of fewer than three corners"),
        ("f 1 3 2\n", "f 1 3 2\nf 1\nf 2 1\n", "2 faces of fewer than three corners"),
        ("v 0 0 1\n", "v 0 0 1\nv nan nan nan\n", ""),
        ("v 0 0 1\n", "v 0 0 1\nv 1 nan 2\nf 1 2 5\n", "1 triangles with such a corner"),
        ("f 1 3 2\n", "f 1 3 2\nf 1 1 2\n", "1 triangles without an area"),
        ("f 1 3 2\n", "f 1 3 2\nf 3 2 1\n", "1 duplicate triangles"),
        ("f 1 3 2\n", "f 1 3 2\nl 1 2\np 1\n", "lines"),
        ("v 0 0 1\n", "v 0 0 1\nv -nan(ind) 1.#QNAN -1.#IND\nv 1\n", "2 vertices with NaN or infinity"),
        ("f 1 3 2\n", "f 1 3 2\nf 1 2 77\n", "1 triangles with a corner of no vertex"),
        ("f 1 3 2\n", "f 1 3 2\nf 2 3 1\n", "1 triangles of the other side: the mesh is double-sided"),
    ],
)
def test_odd_rows_are_left_out_and_said(old: str, new: str, ignored: str) -> None:
    found = converted(SHEET.replace(old, new).encode())
    assert len(found.tensors["faces"]) == 4
    assert found.why[1] == "watertight"
    assert not ignored or f"ignored: {ignored}" in found.why


def test_a_double_sided_mesh_has_one_side() -> None:
    both = BALL.copy()
    both.faces = np.concatenate([BALL.faces, BALL.faces[:, ::-1]])
    found = converted(bytes(both.export(file_type="stl")))
    assert len(found.tensors["faces"]) == len(BALL.faces)
    assert found.why[1] == "watertight"
    assert f"ignored: {len(BALL.faces)} triangles of the other side: the mesh is double-sided" in found.why


def test_a_wall_between_two_solids_has_both_sides() -> None:
    beside = trimesh.creation.box((1, 1, 1))
    beside.apply_translation((1, 0, 0))
    both = trimesh.util.concatenate([trimesh.creation.box((1, 1, 1)), beside])
    assert len(converted(bytes(both.export(file_type="stl"))).tensors["faces"]) == 24


def test_what_changes_the_shape_and_is_not_read_is_warned_of() -> None:
    found = converted((SHEET + "cstype bezier\nsurf 0 1 0 1 1 2 3 4\nend\n").encode())
    assert "GEOMETRY_IGNORED: not read: 1 free-form surfaces" in found.warnings
    far = SHEET + "v 50 0 0\nv 51 0 0\nv 50 1 0\nf 5 6 7\n"
    assert [warning.partition(":")[0] for warning in converted(far.encode()).warnings] == ["STRAY_PARTS"]


def test_ply_vertices_with_lists_are_read() -> None:
    header = PLY_TRIANGLE.replace("property float z\n", "property float z\nproperty list uchar int views\n")
    data = header.replace("0 0 0\n1 0 0\n0 1 0\n", "0 0 0 2 7 8\n1 0 0 0\n0 1 0 1 9\n")
    np.testing.assert_array_equal(read_mesh("ply", memoryview(data.encode())).vertices[1], [1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("head", "format_"),
    [
        *((b"PXR-USDC\0", "usd"), (b"\xef\xbb\xbf#usda 1.0\n", "usd"), (b"ISO-10303-21;\nHEADER;", "step")),
        *((b'<?xml version="1.0"?>\n<robot name="r">', "urdf"), (b"\xef\xbb\xbf\r\n<robot name='arm'>", "urdf")),
        *((b"<!-- a <sdf> --><!-- b -->\n<robot>", "urdf"), (b"<?xml?><model><robot/></model>", None)),
        *((zip_bytes([("3D/3dmodel.model", b"")]), "3mf"), (zip_bytes([("_rels/.rels", b"")]), "3mf")),
        *((zip_bytes([("scene.usdc", b"")]), "usd"), (zip_bytes([("run/scene.glb", b"")]), "zip")),
    ],
)
def test_scenes_and_models_of_cad_are_recognized(head: bytes, format_: str | None) -> None:
    assert sniff_format(head + bytes(500)) == format_


@pytest.mark.parametrize("count", [0, 0xFFFFFFFF, 20])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 0.0), (7.0, 8.0, 9.0), (math.nan,) * 3])
def test_binary_stl_files_whose_normals_or_count_mean_nothing(count: int, normal: tuple[float, ...]) -> None:
    corners = BALL.triangles[:20].reshape(20, 9)
    facets = b"".join(struct.pack("<12fH", *normal, *each, 0) for each in [*corners[:19], [math.nan] * 9])
    data = b"{a header}".ljust(80) + struct.pack("<I", count) + facets
    assert sniff_format(data[:HEAD_BYTES]) == "stl"
    assert len(read_mesh("stl", memoryview(data)).faces) == 20
    beyond = read_mesh("stl", memoryview(data[:80] + struct.pack("<I", 15) + facets))
    assert beyond.not_applied == ("5 facets beyond the 15 of its header",)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        *(("ply\n", "PLY\n"), ("ascii 1.0", "ascii"), ("float x", "float X"), ("vertex_indices", "corners")),
        *(
            ("element vertex", "element vertices"),
            ("uchar int", "uchar int64"),
            ("\n", "\r"),
            ("end_header\n", "end_header\n\ufeff"),
        ),
    ],
)
def test_unusual_ply_headers_are_read(old: str, new: str) -> None:
    data = PLY_TRIANGLE.replace(old, new).encode()
    assert sniff_format(data) == "ply"
    assert read_mesh("ply", memoryview(data)).faces.tolist() == [[0, 1, 2]]


def test_a_ply_text_whose_rows_are_not_as_its_header_says_is_refused() -> None:
    with pytest.raises(FieldFormatError, match="says 4 numbers for each vertex, but its first line has 3"):
        read_mesh("ply", memoryview(PLY_TRIANGLE.replace("float z\n", "float z\nproperty float w\n").encode()))


TABLE = [f"{n},{a:.6f},{b:.6f},{c:.6f},wall,{a:.6f},{b:.6f},{c:.6f}" for n, (a, b, c) in enumerate(AROUND)]


@pytest.mark.parametrize(
    "lines",
    [
        *(["id,x,y,z,label,nx,ny,nz", *TABLE], ['"x","y","z"', *(",".join(row.split(",")[1:4]) for row in TABLE)]),
        *(TABLE, ["% a table", *TABLE, "END"], [*TABLE[:200], "1,2", *TABLE[200:]]),
    ],
)
def test_tables_of_points_are_read_by_their_names_and_numbers(lines: list[str]) -> None:
    data = "\n".join(lines).encode()
    assert sniff_format(data[:HEAD_BYTES]) == "xyz"
    found = read_mesh("xyz", memoryview(data))
    np.testing.assert_allclose(found.vertices, AROUND, atol=1e-6)
    assert (found.normals is None) == lines[0].startswith('"')


def test_bytes_behind_the_triangles_of_an_stl_file_are_passed_over() -> None:
    facet = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
    data = b"made by a program".ljust(80) + struct.pack("<I", 2) + 2 * facet
    found = read_mesh("stl", memoryview(data + bytes(7)))
    np.testing.assert_array_equal(found.faces, read_mesh("stl", memoryview(data)).faces)
    assert found.left_out == ("7 bytes after the triangles",)
    with pytest.raises(FieldFormatError, match="ends within its 2 facets"):
        read_mesh("stl", memoryview(data[:-7]))


@pytest.mark.parametrize(
    ("format_", "text"),
    [
        ("obj", "v 0,0 1,5 0,0\nv 1,0 0,0 0,0\nv 0,0 0,5 0,0\nf 1 2 3\n"),
        ("stl", "solid a\nfacet normal 0 0 1\nouter loop\n" + "vertex 0,0 1,5 0,0\n" * 3 + "endloop\nendfacet\n"),
    ],
)
def test_decimal_commas_are_named(format_: str, text: str) -> None:
    assert sniff_format(text.encode()) == format_
    with pytest.raises(FieldFormatError, match="write decimal points, not commas"):
        read_mesh(format_, memoryview(text.encode()))
