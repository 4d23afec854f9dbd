"""Mesh files that lie, reach elsewhere or ask for too much."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.importing.families.mesh import convert_mesh
from regnf_core.importing.meshes import triangle_files
from regnf_core.importing.upload_description import UploadDescription
from tests.core.importing.archives import assert_refused, saved
from tests.core.importing.in_process import convert
from tests.core.importing.meshes.mesh_files import PLY_TRIANGLE, converted, exported


def assert_rejected(data: bytes, reason: str, format_: str | None = None) -> None:
    kind = format_ or str(sniff_format(data[:HEAD_BYTES]))
    assert_refused(lambda: convert_mesh(kind, memoryview(data), UploadDescription()), reason)


def glb(document: Any, binary: bytes = b"", version: int = 2) -> bytes:
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", version, 12 + len(body)) + body


def triangle(**changes: Any) -> dict[str, Any]:
    """A glTF document of one triangle; its binary chunk is TRIANGLE."""
    return {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36}],
    } | changes


TRIANGLE = np.eye(3, dtype="<f4").tobytes()
POSITION = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}


def test_the_triangle_alone_is_taken() -> None:
    found = converted(glb(triangle(), TRIANGLE))
    np.testing.assert_array_equal(np.sort(found.tensors["vertices"], axis=0), np.sort(np.eye(3), axis=0))
    strip = triangle(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 5}]}])
    assert len(converted(glb(strip, TRIANGLE)).tensors["faces"]) == 1


@pytest.mark.parametrize(
    ("document", "reason"),
    [
        *((b"{nonsense", "MESH_INVALID"), (b"[" * 100_000, "MESH_INVALID"), ([1], "MESH_INVALID")),
        *((triangle(nodes=[]) | {"meshes": []}, "MESH_INVALID"), (triangle(nodes=[{"mesh": 7}]), "MESH_INVALID")),
        (triangle(nodes=[{"mesh": 0, "children": [0]}]), "MESH_INVALID"),  # a loop
        (triangle(nodes=[{"mesh": 0, "children": [1, 1]}, {}]), "MESH_INVALID"),
        (triangle(nodes=[{"mesh": 0, "rotation": [0, 0, 0, 0]}]), "MESH_INVALID"),
        (triangle(nodes=[{"mesh": 0, "scale": [1e308, 1e308, 1e308]}]), "MESH_INVALID"),
        (triangle(nodes=[{"mesh": 0, "matrix": [1, 2, 3]}]), "MESH_INVALID"),
        (triangle(nodes=[{"mesh": "0"}]), "MESH_INVALID"),
        (triangle(accessors=[POSITION | {"count": 4}]), "MESH_INVALID"),
        (triangle(accessors=[POSITION | {"count": 1 << 40}]), "MESH_INVALID"),
        (triangle(accessors=[POSITION | {"count": -1}]), "MESH_INVALID"),
        (triangle(accessors=[POSITION | {"byteOffset": 4}]), "MESH_INVALID"),
        (triangle(accessors=[POSITION | {"componentType": 5130}]), "MESH_INVALID"),
        (triangle(accessors=[POSITION | {"type": "MAT4"}]), "MESH_INVALID"),
        (triangle(accessors=[POSITION | {"sparse": {}}]), "MESH_INVALID"),
        (triangle(bufferViews=[{"buffer": 0, "byteLength": 1 << 30}]), "MESH_INVALID"),
        (triangle(bufferViews=[{"buffer": 0, "byteLength": 36, "byteStride": 0}]), "MESH_INVALID"),
        (triangle(bufferViews=[{"buffer": 0, "byteLength": 36, "byteStride": 1 << 40}]), "MESH_INVALID"),
        (triangle(buffers=[{"byteLength": 36, "uri": "../../secret.bin"}]), "MESH_EXTERNAL_REFERENCE"),
        (triangle(buffers=[{"byteLength": 36, "uri": "data:;base64,AAAA"}]), "MESH_INVALID"),
        (triangle(extensionsRequired=["KHR_draco_mesh_compression"]), "FORMAT_NOT_SUPPORTED"),
        (
            triangle(bufferViews=[{"buffer": 0, "byteLength": 36, "extensions": {"EXT_meshopt_compression": {}}}]),
            "FORMAT_NOT_SUPPORTED",
        ),
    ],
)
def test_faulty_glb_files(document: Any, reason: str) -> None:
    assert_rejected(glb(document, TRIANGLE), reason)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        *(("end_header\n", "", "MESH_INVALID"), ("ascii", "utf8", "MESH_INVALID")),
        *(("vertex 3", "vertex 4", "MESH_INVALID"), ("vertex 3", "vertex 3000000000", "MESH_TOO_LARGE")),
        *(("face 1", "face 2", "MESH_INVALID"), ("face 1", "face 99999999999", "MESH_TOO_LARGE")),
        *(("face 1", "face -1", "MESH_INVALID"), ("float z", "float x", "MESH_INVALID")),
        *(("float z", "float w", "MESH_INVALID"), ("float z", "list uchar float z", "MESH_INVALID")),
        *(("float z", "quaternion z", "MESH_INVALID"), ("uchar int", "float int", "MESH_INVALID")),
        *(("vertex_indices", "corners", "MESH_INVALID"), ("element face", "element vertex", "MESH_INVALID")),
        *(("3 0 1 2", "3 0 1 3", "MESH_INVALID"), ("3 0 1 2", "3 0 1 -1", "MESH_INVALID")),
        *(("3 0 1 2", "2 0 1", "MESH_INVALID"), ("3 0 1 2", "1e300 0 1 2", "MESH_INVALID")),
        ("3 0 1 2", "3 0 1 nan", "MESH_INVALID"),
        ("3 0 1 2", "3 0 1 1", "MESH_INVALID"),  # no area
        *(("1 0 0", "1 0 inf", "MESH_INVALID"), ("1 0 0", "1 0 zero", "MESH_INVALID")),
    ],
)
def test_faulty_ply_files(old: str, new: str, reason: str) -> None:
    assert old in PLY_TRIANGLE
    assert_rejected(PLY_TRIANGLE.replace(old, new).encode(), reason)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "MESH_INVALID"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", "MESH_INVALID"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "MESH_INVALID"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "MESH_INVALID"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -9\n", "MESH_INVALID"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 x\n", "MESH_INVALID"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3" + "0" * 30 + "\n", "MESH_INVALID"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n", "MESH_INVALID"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "MESH_INVALID"),
        ("v 0 0 0\ncall other.obj\n", "MESH_EXTERNAL_REFERENCE"),
        ("v 0 0 0\ncsh rm -r everything\n", "MESH_EXTERNAL_REFERENCE"),
    ],
)
def test_faulty_obj_files(text: str, reason: str) -> None:
    assert_rejected(text.encode(), reason, "obj")


@pytest.mark.parametrize(
    "data",
    [
        exported("stl")[:-1],
        b"solid ball\nfacet normal 0 0 1\nvertex 0 0\nendfacet",
        b"solid ball\nfacet normal 0 0 1\nvertex 0 0 0\nvertex 1 0 0\nendfacet",
        b"solid ball\nfacet normal 0 0 1\nendfacet",
    ],
)
def test_faulty_stl_files(data: bytes) -> None:
    assert_rejected(data, "MESH_INVALID")


def test_more_triangles_than_anybody_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(triangle_files, "MAX_TRIANGLES", 100)
    for kind in ("ply", "stl", "obj", "glb"):
        assert_rejected(exported(kind), "MESH_TOO_LARGE")


def test_a_sheet_is_free_before_its_face_and_matter_behind(tmp_path: Path) -> None:
    upload = saved(tmp_path, PLY_TRIANGLE.encode())
    report = convert(upload, tmp_path / "out")
    assert any("parts of the surface are missing" in why for why in report["why"])
