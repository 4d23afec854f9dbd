"""A mesh file as an exact distance field outside of the gate: for files that are the user's own."""

from __future__ import annotations

import os

import numpy as np

from regnf_core.fields.mesh import MeshField
from regnf_core.importing.families.facing import Asked
from regnf_core.importing.families.triangles import oriented, welded


def load_solid(path: str | os.PathLike[str], asked: Asked = None) -> tuple[MeshField, tuple[str, ...]]:
    """The field of a glb, ply, obj or stl file with its faces turned as an upload's are, and what was done to them.

    asked: what the mesh is, where that is known; else its faces decide whether it is a room.
    Raises FieldFormatError (MESH_INVALID) when the file is malformed or holds no triangles with an area, and OSError.
    """
    given = MeshField.load(path)
    vertices, faces, _ = welded(given.vertices, given.faces)
    places = vertices.astype(np.float64)
    facing = oriented(places, faces, asked)
    return MeshField(places, facing.faces, inside_above=facing.level), (*facing.why, *facing.warnings)
