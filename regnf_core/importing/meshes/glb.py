"""glTF 2.0, binary or text: the triangles of all nodes at their poses, with their vertices' or materials' colors.
Textures, skins and morphs are ignored.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from regnf_core.importing.meshes.geometry import (
    Float64Array,
    Geometry,
    Int64Array,
    Siblings,
    fan,
    malformed,
    require_room,
    strips,
    unsupported,
)
from regnf_core.importing.meshes.glb_buffers import Accessors
from regnf_core.importing.meshes.glb_colors import joined_colors, primitive_colors
from regnf_core.importing.meshes.glb_nodes import placed_meshes

_HEADER, _CHUNK_HEADER = 12, 8
_JSON, _BIN = b"JSON", b"BIN\0"
_MAX_JSON = 64 << 20
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_punctual", "KHR_mesh_quantization")


def read_glb(data: memoryview, siblings: Siblings | None = None) -> Geometry:
    """The triangles of a .glb file's scene. ``siblings``: the files that came with it, by name.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, FORMAT_NOT_SUPPORTED for compressed or sparse buffers, or
    MESH_EXTERNAL_REFERENCE for buffers in files that did not come with it.
    """
    document, binary = _chunks(data)
    return _geometry(document, binary, siblings or {})


def read_gltf(data: memoryview, siblings: Siblings | None = None) -> Geometry:
    """The triangles of a .gltf file's scene, its buffers within it or beside it. Raises as :func:`read_glb`."""
    return _geometry(_document(data), None, siblings or {})


def _geometry(document: dict[str, Any], binary: memoryview | None, siblings: Siblings) -> Geometry:
    try:
        return _scene(document, Accessors(document, binary, siblings))
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise malformed(f"the glTF document contradicts itself ({type(error).__name__})") from error


def _chunks(data: memoryview) -> tuple[dict[str, Any], memoryview]:
    if len(data) < _HEADER + _CHUNK_HEADER or int.from_bytes(data[4:8], "little") != 2:
        raise malformed("not a glTF file of version 2")
    found: dict[bytes, memoryview] = {}
    at = _HEADER
    while at + _CHUNK_HEADER <= len(data):
        length, kind = int.from_bytes(data[at : at + 4], "little"), bytes(data[at + 4 : at + 8])
        at += _CHUNK_HEADER
        if at + length > len(data):
            raise malformed("the glTF file ends within a chunk")
        found.setdefault(kind, data[at : at + length])
        at += length
    text = found.get(_JSON)
    if text is None:
        raise malformed("the glTF file has no JSON chunk")
    return _document(text), found.get(_BIN, memoryview(b""))


def _document(text: memoryview) -> dict[str, Any]:
    if len(text) > _MAX_JSON:
        raise malformed("the glTF file's JSON is too long")
    try:
        document = json.loads(bytes(text).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise malformed("the glTF file's JSON is malformed") from error
    if not isinstance(document, dict):
        raise malformed("the glTF file's JSON is not an object")
    return document


def _scene(document: dict[str, Any], accessors: Accessors) -> Geometry:
    unknown = [name for name in document.get("extensionsRequired", []) if not str(name).startswith(_HARMLESS)]
    if unknown:
        raise unsupported(f"the glTF file needs the extension {str(unknown[0])[:60]}: export it without compression")
    vertices: list[Float64Array] = []
    faces: list[Int64Array] = []
    colors: list[Float64Array | None] = []
    so_far = triangles = 0
    for number, matrix in placed_meshes(document):
        for primitive in document["meshes"][number]["primitives"]:
            if primitive.get("mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN):
                continue
            places = accessors.array(primitive["attributes"]["POSITION"], 3)
            corners = _triangles(primitive, accessors, len(places))
            if len(corners) and (corners.min() < 0 or corners.max() >= len(places)):
                raise malformed("a glTF face names a vertex that does not exist")
            turned = np.linalg.det(matrix[:3, :3]) < 0  # a mirrored node turns its faces round
            vertices.append(places @ matrix[:3, :3].T + matrix[:3, 3])
            colors.append(primitive_colors(document, primitive, accessors, len(places)))
            faces.append((corners[:, ::-1] if turned else corners) + so_far)
            so_far, triangles = so_far + len(places), triangles + len(corners)
            require_room(so_far, triangles)
    empty = np.zeros((0, 3))
    return Geometry(
        np.concatenate([empty, *vertices]),
        np.concatenate([empty.astype(np.int64), *faces]),
        colors=joined_colors(colors, [len(part) for part in vertices]),
        left_out=_left_out(document),
    )


def _triangles(primitive: dict[str, Any], accessors: Accessors, vertices: int) -> Int64Array:
    if "indices" in primitive:
        order = accessors.array(primitive["indices"], 1).astype(np.int64).reshape(-1)
    else:
        order = np.arange(vertices, dtype=np.int64)
    mode = primitive.get("mode", _TRIANGLES)
    if mode == _TRIANGLES:
        if len(order) % 3:
            raise malformed("glTF triangles without three corners")
        return order.reshape(-1, 3)
    return fan(order) if mode == _FAN else strips(order)


def _left_out(document: dict[str, Any]) -> tuple[str, ...]:
    parts = {"skins": "skins", "animations": "animations", "images": "textures"}
    return tuple(word for key, word in parts.items() if document.get(key))
