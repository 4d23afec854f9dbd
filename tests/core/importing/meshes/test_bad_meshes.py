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


def faulty_documents() -> dict[str, list[Any]]:
    view = {"buffer": 0, "byteLength": 36}
    nodes = [
        *({"mesh": 7}, {"mesh": "0"}, {"mesh": 0, "children": [0]}, {"mesh": 0, "rotation": [0, 0, 0, 0]}),
        *({"mesh": 0, "scale": [1e308, 1e308, 1e308]}, {"mesh": 0, "matrix": [1, 2, 3]}),
    ]
    positions = [
        *({"count": 4}, {"count": 1 << 40}, {"count": -1}, {"byteOffset": 4}, {"componentType": 5130}),
        *({"type": "MAT4"}, {"sparse": {}}),
    ]
    views = [{"byteLength": 1 << 30}, {"byteStride": 0}, {"byteStride": 1 << 40}]
    packed = {"extensions": {"EXT_meshopt_compression": {}}}
    codec = {"buffer": 0, "byteLength": 36, "byteStride": 12, "count": 3, "mode": "ATTRIBUTES"}
    draco = {"attributes": {"POSITION": 0}, "indices": 0}
    draco |= {"extensions": {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}}
    absent = {"componentType": 5126, "count": 3, "type": "VEC3"}
    return {
        "MESH_INVALID": [
            *(b"{nonsense", b"[" * 100_000, [1], triangle(nodes=[]) | {"meshes": []}),
            *(triangle(nodes=[node]) for node in nodes),
            triangle(nodes=[{"mesh": 0, "children": [1, 1]}, {}]),
            *(triangle(accessors=[POSITION | change]) for change in positions),
            *(triangle(bufferViews=[view | change]) for change in views),
            triangle(buffers=[{"byteLength": 36, "uri": "data:;base64,AAAA"}]),
            triangle(bufferViews=[view | packed]),
            triangle(bufferViews=[view | {"extensions": {"EXT_meshopt_compression": codec}}]),
            triangle(bufferViews=[view | {"extensions": {"EXT_meshopt_compression": codec | {"count": 1 << 40}}}]),
            triangle(accessors=[absent], meshes=[{"primitives": [draco]}]),
        ],
        "MESH_EXTERNAL_REFERENCE": [triangle(buffers=[{"byteLength": 36, "uri": "../../secret.bin"}])],
        "FORMAT_NOT_SUPPORTED": [
            triangle(extensionsRequired=["EXT_of_nobody"]),
            triangle(accessors=[absent], meshes=[{"primitives": [draco | {"mode": 5}]}]),
        ],
    }


@pytest.mark.parametrize(("reason", "documents"), faulty_documents().items())
def test_faulty_glb_files(reason: str, documents: list[Any]) -> None:
    for document in documents:
        assert_rejected(glb(document, TRIANGLE), reason)


@pytest.mark.parametrize(
    ("old", "news", "reason"),
    [
        *(("end_header\n", [""], "MESH_INVALID"), ("ascii", ["utf8"], "MESH_INVALID")),
        *(("vertex 3", ["vertex 4"], "MESH_INVALID"), ("vertex 3", ["vertex 3000000000"], "MESH_TOO_LARGE")),
        *(("face 1", ["face 2", "face -1"], "MESH_INVALID"), ("face 1", ["face 99999999999"], "MESH_TOO_LARGE")),
        ("float z", ["float x", "float w", "list uchar float z", "quaternion z"], "MESH_INVALID"),
        *(
            ("uchar int", ["float int"], "MESH_INVALID"),
            ("vertex_indices", ["a\nproperty list uchar int b"], "MESH_INVALID"),
        ),
        ("element face", ["element vertex"], "MESH_INVALID"),
        ("3 0 1 2", ["3 0 1 3", "3 0 1 -1", "2 0 1", "1e300 0 1 2", "3 0 1 nan", "3 0 1 1"], "MESH_INVALID"),
        ("1 0 0", ["1 0 inf", "1 0 zero"], "MESH_INVALID"),
    ],
)
def test_faulty_ply_files(old: str, news: list[str], reason: str) -> None:
    assert old in PLY_TRIANGLE
    for new in news:
        assert_rejected(PLY_TRIANGLE.replace(old, new).encode(), reason)


def test_faulty_obj_and_stl_files() -> None:
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    faces = ("", *(f"f {face}\n" for face in ("1 2", "1 2 9", "0 1 2", "1 2 -9", "1 2 x", "1 2 3" + "0" * 30)))
    texts = [corners + face for face in faces]
    texts += [corners.replace(*change) + "f 1 2 3\n" for change in (("v 0 0 0", "v 0 0"), ("1 0\n", "1 nan\n"))]
    for text in texts:
        assert_rejected(text.encode(), "MESH_INVALID", "obj")
    for text in ("v 0 0 0\ncall other.obj\n", "v 0 0 0\ncsh rm -r everything\n"):
        assert_rejected(text.encode(), "MESH_EXTERNAL_REFERENCE", "obj")
    assert_rejected(exported("stl")[:-1], "MESH_INVALID")
    for vertices in (b"vertex 0 0\n", b"vertex 0 0 0\nvertex 1 0 0\n", b""):
        assert_rejected(b"solid ball\nfacet normal 0 0 1\n" + vertices + b"endfacet", "MESH_INVALID")


def test_more_triangles_than_anybody_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(triangle_files, "MAX_TRIANGLES", 100)
    for kind in ("ply", "stl", "obj", "glb"):
        assert_rejected(exported(kind), "MESH_TOO_LARGE")


def test_a_sheet_is_free_before_its_face_and_matter_behind(tmp_path: Path) -> None:
    upload = saved(tmp_path, PLY_TRIANGLE.encode())
    report = convert(upload, tmp_path / "out")
    assert any("parts of the surface are missing" in why for why in report["why"])
