"""Drawing a stored field: its surface as a mesh in two levels of detail, and a picture."""

from __future__ import annotations

import io
import time
from contextlib import suppress
from pathlib import Path

from regnf_core.errors import RegnfError
from regnf_core.field_views import FieldViews
from regnf_core.fields.base import SdfField
from regnf_core.fields.build import open_field
from regnf_core.schema.safe_format import read_description
from regnf_core.viewing.display_mesh import TooSlowError, display_meshes
from regnf_core.viewing.field_picture import field_picture
from regnf_core.viewing.mesh_file import mesh_file
from regnf_core.viewing.vertex_clustering import Triangles

_BUDGET_S = 5.0
"""Processor seconds of the mesh, and of the picture."""


def field_views(path: Path) -> FieldViews:
    """Draw the safe field in the file ``path``. What cannot be drawn in good time is left out.

    Raises FieldFormatError for a file that is no safe field.
    """
    field, up_axis = open_field(path), read_description(path)["up_axis"]
    fine = coarse = None
    with suppress(RegnfError, MemoryError):
        found = display_meshes(field, _BUDGET_S)
        fine, coarse = _file_of(found.fine), None if found.coarse is None else _file_of(found.coarse)
    return FieldViews(fine, coarse, _picture(field, up_axis))


def _file_of(mesh: Triangles) -> bytes:
    return mesh_file(mesh.vertices, mesh.faces, mesh.normals, mesh.colors)


def _picture(field: SdfField, up_axis: str | None) -> bytes | None:
    end = time.process_time() + _BUDGET_S

    def watch(_: int) -> None:
        if time.process_time() > end:
            raise TooSlowError("the field is too slow to be drawn")

    file = io.BytesIO()
    try:
        field_picture(field, up_axis, progress=watch).save(file, "PNG")
    except (RegnfError, MemoryError):
        return None
    return file.getvalue()
