"""Meshes for tests, as files and as fields."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import trimesh

from regnf_core.fields.build import build_field
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.mesh import convert_mesh
from regnf_core.importing.meshes import MESH_READERS
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.safe_format import parse_description

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
FACES = BALL.faces.tolist()
PLY_TRIANGLE = (
    "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)


def converted(data: bytes, **said: Any) -> ConvertedField:
    format_ = sniff_format(data[:HEAD_BYTES])
    assert format_ in MESH_READERS
    return convert_mesh(format_, memoryview(data), UploadDescription.from_dict(said))


def field_of(found: ConvertedField) -> Any:
    """As its file would be opened."""
    tensors = {name: torch.from_numpy(np.array(array)) for name, array in found.tensors.items()}
    return build_field(parse_description(found.description), tensors)


def exported(kind: str, **options: Any) -> bytes:
    data = BALL.export(file_type=kind, **options)
    return data.encode() if isinstance(data, str) else bytes(data)


def glb_parts() -> tuple[bytes, dict[str, memoryview]]:
    """BALL as glTF in several files: the document, and the files beside it."""
    files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(BALL))  # type: ignore[no-untyped-call]
    return bytes(files.pop("model.gltf")), {name: memoryview(data) for name, data in files.items()}


def strips_ply(binary: bool = False) -> bytes:
    """A tetrahedron as two strips."""
    strips = [0, 2, 1, 3, -1, 3, 0, 2, -1, 0, 1, 3]
    header = (
        f"ply\nformat {'binary_big_endian' if binary else 'ascii'} 1.0\nelement vertex 4\nproperty float x\n"
        "property float y\nproperty float z\nelement tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    )
    corners = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
    if binary:
        body = b"".join(struct.pack(">3f", *corner) for corner in corners)
        return header.encode() + body + struct.pack(f">{len(strips) + 1}i", len(strips), *strips)
    text = "".join(f"{x} {y} {z}\n" for x, y, z in corners)
    return (header + text + " ".join(map(str, [len(strips), *strips])) + "\n").encode()


def pcd(points: npt.NDArray[np.float64], normals: npt.NDArray[np.float64] | None, data: str) -> bytes:
    names = "x y z" + (" normal_x normal_y normal_z curvature" if normals is not None else "")
    columns = points if normals is None else np.hstack([points, normals, np.zeros((len(points), 1))])
    width = columns.shape[1]
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {names}\nSIZE {'4 ' * width}\n"
        f"TYPE {'F ' * width}\nCOUNT {'1 ' * width}\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points)}\nDATA {data}\n"
    ).encode()
    if data == "ascii":
        return header + "\n".join(" ".join(map(repr, row)) for row in columns.tolist()).encode()
    if data == "binary":
        return header + columns.astype("<f4").tobytes()
    raw = columns.T.astype("<f4").tobytes()
    packed = literal_lzf(raw)
    return header + struct.pack("<II", len(packed), len(raw)) + packed


def literal_lzf(raw: bytes) -> bytes:
    """LZF that copies nothing but runs of zeros."""
    packed = b""
    at = 0
    while at < len(raw):
        run = len(raw[at : at + 200]) - len(raw[at : at + 200].lstrip(b"\0"))
        if at and raw[at - 1] == 0 and run > 9:
            packed += bytes([7 << 5, run - 9, 0])
            at += run
        else:
            piece = raw[at : at + (1 if raw[at] == 0 else 32)]
            packed += bytes([len(piece) - 1]) + piece
            at += len(piece)
    return packed
