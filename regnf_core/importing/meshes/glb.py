"""glTF 2.0, binary or text: the triangles of all nodes and instances at their poses, skins at rest, morph targets at
their default weights, with their vertices' or materials' colors. Textures are ignored; every extension that may change
the shape and is not applied is said.
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
from regnf_core.importing.meshes.glb_buffers import COMPRESSED, Accessors
from regnf_core.importing.meshes.glb_colors import joined_colors, primitive_colors
from regnf_core.importing.meshes.glb_nodes import CENTER, INSTANCES, VISIBILITY, placed_meshes

_HEADER, _CHUNK_HEADER = 12, 8
_JSON, _BIN = b"JSON", b"BIN\0"
_MAX_JSON = 64 << 20
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_IGNORED = {"animations": "animations", "images": "textures"}
_APPLIED = frozenset({INSTANCES, VISIBILITY, CENTER, *COMPRESSED})
_NO_SHAPE = (
    *("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "MSFT_packing_", "ADOBE_materials_"),
    *("KHR_lights_", "EXT_lights_", "KHR_techniques_webgl", "EXT_materials_", "CESIUM_primitive_outline", "VRM"),
    *("KHR_mesh_quantization", "EXT_mesh_manifold", "FB_ngon_encoding", "MSFT_lod", "KHR_xmp", "KHR_animation_"),
    *("EXT_mesh_features", "EXT_instance_features", "EXT_structural_metadata", "EXT_feature_metadata"),
    *("KHR_audio", "MSFT_audio", "KHR_physics_", "OMI_", "KHR_interactivity", "KHR_node_select", "KHR_node_hover"),
)
"""Beginnings of the names of extensions that leave triangles where they are. All others are said."""


def read_glb(data: memoryview, siblings: Siblings | None = None) -> Geometry:
    """The triangles of a .glb file's scene. ``siblings``: the files that came with it, by name.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, FORMAT_NOT_SUPPORTED for compressed buffers, or
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
    required, used = (
        [str(name)[:60] for name in document.get(key, []) if not str(name).startswith(_NO_SHAPE)]
        for key in ("extensionsRequired", "extensionsUsed")
    )
    if unknown := [name for name in required if name not in _APPLIED or name in COMPRESSED]:
        raise unsupported(f"the glTF file needs the extension {unknown[0]}, which is not read: export it without")
    vertices: list[Float64Array] = []
    faces: list[Int64Array] = []
    colors: list[Float64Array | None] = []
    flat: set[str] = set()
    so_far = triangles = 0
    for placed in placed_meshes(document, accessors):
        mesh = document["meshes"][placed.mesh]
        for primitive in mesh["primitives"]:
            if (mode := primitive.get("mode", _TRIANGLES)) not in (_TRIANGLES, _STRIP, _FAN):
                flat.add("points" if mode == 0 else "lines")
                continue
            _require_plain(primitive, accessors)
            places = _morphed(primitive, placed.weights or mesh.get("weights"), accessors)
            corners = _triangles(primitive, accessors, len(places))
            if len(corners) and (corners.min() < 0 or corners.max() >= len(places)):
                raise malformed("a glTF face names a vertex that does not exist")
            painted = primitive_colors(document, primitive, accessors, len(places))
            count = len(placed.matrices) if placed.joints is None else 1
            require_room(so_far + count * len(places), triangles + count * len(corners))
            for matrix in placed.matrices[:count]:
                if placed.joints is not None:
                    places, matrix = _skinned(places, primitive, placed.joints, accessors), np.eye(4)
                turned = np.linalg.det(matrix[:3, :3]) < 0  # a mirrored node turns its faces round
                vertices.append(places @ matrix[:3, :3].T + matrix[:3, 3])
                colors.append(painted)
                faces.append((corners[:, ::-1] if turned else corners) + so_far)
                so_far, triangles = so_far + len(places), triangles + len(corners)
    empty = np.zeros((0, 3))
    return Geometry(
        np.concatenate([empty, *vertices]),
        np.concatenate([empty.astype(np.int64), *faces]),
        colors=joined_colors(colors, [len(part) for part in vertices]),
        left_out=(*sorted(flat), *(word for key, word in _IGNORED.items() if document.get(key))),
        not_applied=tuple(f"extension {name}" for name in used if name not in _APPLIED),
    )


def _require_plain(primitive: dict[str, Any], accessors: Accessors) -> None:
    """Raise FieldFormatError (FORMAT_NOT_SUPPORTED) where the vertices are in compressed form alone."""
    packed = [name for name in primitive.get("extensions", {}) if name in COMPRESSED]
    if packed and not accessors.is_stored(primitive["attributes"]["POSITION"]):
        raise unsupported(f"the glTF file's meshes are compressed by {packed[0]}: export it without compression")


def _morphed(primitive: dict[str, Any], weights: list[float] | None, accessors: Accessors) -> Float64Array:
    """The places (V, 3) with the morph targets at these weights."""
    places = accessors.array(primitive["attributes"]["POSITION"], 3)
    for weight, target in zip(weights or (), primitive.get("targets", []), strict=False):
        if weight != 0.0 and "POSITION" in target:
            moved = accessors.array(target["POSITION"], 3)
            if len(moved) != len(places):
                raise malformed("a glTF morph target of another number of vertices")
            places = places + float(weight) * moved
    return places


def _skinned(
    places: Float64Array, primitive: dict[str, Any], joints: Float64Array, accessors: Accessors
) -> Float64Array:
    """The places (V, 3) where the joints (J, 4, 4) hold them; the node's own pose says nothing of a skin's mesh."""
    attributes = primitive["attributes"]
    blended = np.zeros((len(places), 4, 4))
    total = np.zeros(len(places))
    for number in range(len(attributes)):
        if f"JOINTS_{number}" not in attributes:
            break
        chosen = accessors.array(attributes[f"JOINTS_{number}"], 4).astype(np.int64)
        weights = accessors.array(attributes[f"WEIGHTS_{number}"], 4)
        if len(chosen) != len(places) or len(weights) != len(places) or (chosen >= len(joints)).any():
            raise malformed("a glTF skin of another number of vertices, or of a joint that does not exist")
        for column in range(4):
            blended += weights[:, column, None, None] * joints[chosen[:, column]]
        total += weights.sum(axis=1)
    if not (total > 0.0).all():
        raise malformed("a glTF vertex that no joint of its skin holds")
    blended /= total[:, None, None]
    moved: Float64Array = np.einsum("vij,vj->vi", blended[:, :3, :3], places) + blended[:, :3, 3]
    return moved


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
