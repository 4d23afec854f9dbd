"""Mesh files: triangles become an exact distance field, points a reconstructed surface."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from regnf_core.importing.families.cloud import MIN_POINTS, convert_cloud
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.triangles import mesh_field
from regnf_core.importing.meshes import CLOUD_FORMATS, read_mesh
from regnf_core.importing.meshes.triangle_files import Siblings, malformed
from regnf_core.importing.upload_description import UploadDescription


def convert_mesh(
    format_: str,
    data: memoryview,
    overrides: UploadDescription,
    work_s: float = math.inf,
    siblings: Siblings | None = None,
    path: Path | None = None,
) -> ConvertedField:
    """The exact distance to the mesh in ``data``, a file of the format that ``sniff_format`` named.

    siblings: the files that came with it in one archive, by their names relative to it · path: where ``data`` is.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, MESH_EXTERNAL_REFERENCE, FORMAT_NOT_SUPPORTED,
    POINT_CLOUD_TOO_SMALL, IMPORT_TOO_COSTLY beyond ``work_s`` estimated seconds, and what ``overrides`` is
    refused for.
    """
    with np.errstate(all="ignore"):  # numbers that overflow are refused as not finite
        geometry = read_mesh(format_, data, siblings, overrides.node, path)
    if len(geometry.faces) > 0:
        return mesh_field(geometry, f"a {format_} file", overrides, work_s=work_s)
    few = MIN_POINTS if format_ == "obj" else 1  # an OBJ file of fewer has lost its faces
    if format_ not in CLOUD_FORMATS or len(geometry.vertices) < few:
        others = (*geometry.left_out, *([f"{len(geometry.vertices)} vertices"] if len(geometry.vertices) else []))
        raise malformed(f"the {format_} file has no triangles" + (f", but {', '.join(others)}" if others else ""))

    return convert_cloud(geometry, f"a {format_} file", overrides, work_s)
