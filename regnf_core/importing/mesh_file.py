"""A mesh file as an exact distance field outside of the importer: for files that are the user's own."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.fields.mesh import MeshField
from regnf_core.importing.containers.sniff import HEAD_BYTES, explain_refusal, sniff_format
from regnf_core.importing.families.facing import Asked
from regnf_core.importing.families.triangles import solid_of
from regnf_core.importing.meshes import MESH_READERS, read_mesh
from regnf_core.importing.meshes.triangle_files import Geometry, malformed


def load_solid(path: str | os.PathLike[str], asked: Asked = None) -> tuple[MeshField, tuple[str, ...]]:
    """The field of a mesh file, its faces turned as an upload's are, and what was done to them. Colors are kept.

    asked: what the mesh is, where that is known; else its faces decide whether it is a room.
    Raises FieldFormatError as ``read_mesh_file`` does, and OSError.
    """
    geometry = read_mesh_file(path)
    solid = solid_of(geometry, asked)
    colors = None if geometry.colors is None else geometry.colors[solid.kept].astype(np.float32)
    field = MeshField(solid.places, solid.facing.faces, inside_above=solid.facing.level, colors=colors)
    return field, (*solid.facing.why, *solid.warnings)


def load_mesh(path: str | os.PathLike[str]) -> MeshField:
    """The field of a mesh file as it is. Raises as ``read_mesh_file`` does."""
    geometry = read_mesh_file(path)
    return MeshField(geometry.vertices, geometry.faces)


def read_mesh_file(path: str | os.PathLike[str]) -> Geometry:
    """The triangles in a file of any format that is imported. Files beside a .gltf are found by their names.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, MESH_EXTERNAL_REFERENCE, FORMAT_NOT_SUPPORTED,
    FORMAT_NOT_RECOGNIZED; and OSError.
    """
    named = Path(path)
    data = named.read_bytes()
    ending = named.suffix.lower().removeprefix(".")
    format_ = sniff_format(data[:HEAD_BYTES]) or (ending if ending in MESH_READERS else None)
    if format_ not in MESH_READERS:
        reason, detail = explain_refusal(data[:HEAD_BYTES], named.name)
        raise FieldFormatError(f"{named.name}: {detail}", reason=reason)
    beside = {}
    if format_ == "gltf":
        beside = {one.name: memoryview(one.read_bytes()) for one in named.parent.iterdir() if one.suffix == ".bin"}
    try:
        with np.errstate(all="ignore"):
            geometry = read_mesh(format_, memoryview(data), beside, named)
    except FieldFormatError as error:
        raise error.told(f"{named.name}: {error}") from error
    if len(geometry.faces) == 0:
        raise malformed(f"{named.name} has no triangles")
    return geometry
