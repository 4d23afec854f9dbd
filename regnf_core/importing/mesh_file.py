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
from regnf_core.importing.meshes.urdf import endings, mesh_names
from regnf_core.importing.run.opened import OTHER_FILES

_LEVELS = 3
"""A robot's meshes are below its file's folder, or below one of those above it: so many are looked into."""


def load_solid(
    path: str | os.PathLike[str], asked: Asked = None, node: str | None = None
) -> tuple[MeshField, tuple[str, ...]]:
    """The field of a mesh file, its faces turned as an upload's are, and what was done to them. Colors are kept.

    asked: what the mesh is, where that is known; else its faces decide whether it is a room · node: of a scene, the
    node to read. Raises FieldFormatError as ``read_mesh_file`` does, and OSError.
    """
    geometry = read_mesh_file(path, node)
    solid = solid_of(geometry, asked)
    colors = None if geometry.colors is None else geometry.colors[solid.kept].astype(np.float32)
    field = MeshField(solid.places, solid.facing.faces, inside_above=solid.facing.level, colors=colors)
    return field, (*solid.facing.why, *solid.warnings)


def load_mesh(path: str | os.PathLike[str]) -> MeshField:
    """The field of a mesh file as it is. Raises as ``read_mesh_file`` does."""
    geometry = read_mesh_file(path)
    return MeshField(geometry.vertices, geometry.faces)


def read_mesh_file(path: str | os.PathLike[str], node: str | None = None) -> Geometry:
    """The triangles in a file of any format that is imported. Files beside it to which it refers are found by their
    names. node: of a scene, the node to read.

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
    try:
        with np.errstate(all="ignore"):
            geometry = read_mesh(format_, memoryview(data), _beside(named, format_, memoryview(data)), node, named)
    except FieldFormatError as error:
        raise error.told(f"{named.name}: {error}") from error
    if len(geometry.faces) == 0:
        raise malformed(f"{named.name} has no triangles")
    return geometry


def _beside(path: Path, format_: str, data: memoryview) -> dict[str, memoryview]:
    """The files to which a mesh file may refer, by the names that it gives them."""
    if format_ == "urdf":
        folders = path.resolve().parents[:_LEVELS]
        places = {name: [near / end for end in endings(name) for near in folders] for name in mesh_names(data)}
        files = {name: next(filter(Path.is_file, near), None) for name, near in places.items()}
    else:
        ends = OTHER_FILES.get(path.suffix.lower(), ()) if format_ in ("gltf", "usd") else ()
        files = {one.name: one for one in (path.parent.iterdir() if ends else ()) if one.suffix.lower() in ends}
    return {name: memoryview(file.read_bytes()) for name, file in files.items() if file is not None and file != path}
