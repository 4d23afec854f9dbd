"""PLY (Stanford), text and binary of either byte order: vertices, their normals, polygons."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.importing.meshes.geometry import (
    Float64Array,
    Geometry,
    Int64Array,
    malformed,
    require_room,
    strips,
    within_unit,
)
from regnf_core.importing.meshes.ply_body import BinaryBody, TextBody
from regnf_core.importing.meshes.ply_header import Element, read_ply_header

_INDEX_NAMES = ("vertex_indices", "vertex_index")
_COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_MAX_ROWS = 50_000_000


def read_ply(data: memoryview) -> Geometry:
    """The vertices and polygons (as fans) or strips of a PLY file; without faces it is a point cloud.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE.
    """
    header = read_ply_header(data)
    rest = data[header.size :]
    body = TextBody(rest) if header.byte_order is None else BinaryBody(rest, header.byte_order)
    vertices, normals, colors = np.zeros((0, 3)), None, None
    faces = np.zeros((0, 3), np.int64)
    left_out: list[str] = []
    for element in header.elements:
        if element.name == "vertex":
            require_room(element.count, 0)
            table = body.scalars(element)
            vertices = _columns(table, ("x", "y", "z"))
            if {"nx", "ny", "nz"} <= table.keys():
                normals = _columns(table, ("nx", "ny", "nz"))
            colors = _colors(table, element)
        elif element.name == "face":
            require_room(0, element.count)
            faces = np.concatenate([faces, body.triangles(element, _index_property(element))])
        elif element.name == "tristrips":
            require_room(0, element.count)
            faces = np.concatenate([faces, *(_strip(order) for order in body.lists(element, _index_property(element)))])
        elif element.count > _MAX_ROWS:
            raise malformed(f"the PLY file claims {element.count} rows of {element.name[:40]}")
        else:
            body.skip(element)
            left_out.append(f"elements {element.name[:40]}")
    if body.flat_faces and len(faces) == 0:
        raise malformed("no face of the PLY file has three corners")
    if body.flat_faces:
        left_out.append(f"{body.flat_faces} faces of fewer than three corners")
    return Geometry(vertices, faces, normals, colors, tuple(left_out))


def _colors(table: dict[str, Float64Array], element: Element) -> Float64Array | None:
    """Of the vertices, in [0, 1]: whole numbers are shares of the largest of their type."""
    types = {p.name: p.type for p in element.properties}
    for names in _COLOR_NAMES:
        kinds = {types.get(name) for name in names}
        if len(kinds) == 1 and None not in kinds:
            kind = np.dtype(kinds.pop())
            return within_unit(_columns(table, names), 1.0 if kind.kind == "f" else float(np.iinfo(kind).max))
    return None


def _strip(order: npt.NDArray[Any]) -> Int64Array:
    require_room(0, len(order))
    return strips(order)


def _columns(table: dict[str, Float64Array], names: tuple[str, ...]) -> Float64Array:
    if not table.keys() >= set(names):
        raise malformed(f"PLY vertices without {', '.join(names)}")
    return np.stack([table[name] for name in names], axis=1)


def _index_property(element: Element) -> str:
    found = [p.name for p in element.properties if p.count_type is not None and p.name in _INDEX_NAMES]
    if len(found) != 1:
        raise malformed("PLY faces or strips without one list of vertex indices")
    return found[0]


def ply_bytes(geometry: Geometry) -> bytes:
    """A binary file of the geometry, places as they are in float64, that ``read_ply`` reads."""
    columns = [("x", geometry.vertices[:, 0], "<f8"), ("y", geometry.vertices[:, 1], "<f8")]
    columns.append(("z", geometry.vertices[:, 2], "<f8"))
    if geometry.normals is not None:
        columns += [(name, geometry.normals[:, axis], "<f8") for axis, name in enumerate(("nx", "ny", "nz"))]
    if geometry.colors is not None:
        levels = np.rint(255.0 * geometry.colors)
        columns += [(name, levels[:, axis], "u1") for axis, name in enumerate(_COLOR_NAMES[0])]
    rows = np.empty(len(geometry.vertices), [(name, kind) for name, _, kind in columns])
    for name, values, _ in columns:
        rows[name] = values
    faces = np.empty(len(geometry.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, geometry.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {'double' if kind == '<f8' else 'uchar'} {name}" for name, _, kind in columns]
    if len(faces):
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    return "\n".join([*header, "end_header", ""]).encode() + rows.tobytes() + faces.tobytes()
