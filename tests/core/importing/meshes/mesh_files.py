"""Meshes for tests, as files and as fields."""

from __future__ import annotations

from typing import Any

import trimesh

from regnf_core.importing.containers.sniff import sniff_format
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.mesh import convert_mesh
from regnf_core.importing.meshes import MESH_READERS
from regnf_core.importing.upload_description import UploadDescription

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
PLY_TRIANGLE = (
    "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)


def converted(data: bytes, **said: Any) -> ConvertedField:
    format_ = sniff_format(data[:512])
    assert format_ in MESH_READERS
    return convert_mesh(format_, memoryview(data), UploadDescription.from_dict(said))


def exported(kind: str, **options: Any) -> bytes:
    data = BALL.export(file_type=kind, **options)
    return data.encode() if isinstance(data, str) else bytes(data)
