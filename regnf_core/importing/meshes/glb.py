"""glTF 2.0, binary or text: the triangles of all nodes and instances at their poses, skins at rest, morph targets at
their default weights, with their vertices' or materials' colors. Textures are ignored; every extension that may change
the shape and is not applied is said.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.assumptions import GLTF
from regnf_core.importing.meshes.accessors import DRACO, MESHOPT, TRIANGLES, Accessors
from regnf_core.importing.meshes.scene import MAX_NODES, Nodes, Part, assembled
from regnf_core.importing.meshes.triangle_files import (
    Float64Array,
    Geometry,
    Int64Array,
    Siblings,
    fan,
    malformed,
    require_room,
    strips,
    unsupported,
    within_unit,
)
from regnf_core.rotations import rotation_rows

_CONTRADICTIONS = (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError)
"""What faulty JSON ends in, where no check says more."""
_TRIANGLES, _STRIP, _FAN = TRIANGLES, 5, 6

# The colors of a glTF document's vertices: their own times the material's, linear light as sRGB. No textures.


def _primitive_colors(
    document: dict[str, Any], primitive: dict[str, Any], accessors: Accessors, vertices: int
) -> Float64Array | None:
    """(V, 3) in [0, 1], R, G, B, of one primitive; None where it has none, or none that makes sense."""
    own = None
    try:
        if (number := primitive["attributes"].get("COLOR_0")) is not None:
            width = 4 if document["accessors"][number]["type"] == "VEC4" else 3
            own = accessors.array(number, width)[:, :3]
        factor = _factor(document, primitive)
    except (FieldFormatError, *_CONTRADICTIONS):
        return None
    if (own is None and factor is None) or (own is not None and len(own) != vertices):
        return None
    linear = within_unit((np.ones((vertices, 3)) if own is None else own) * (1.0 if factor is None else factor))
    # IEC 61966-2-1: images have such numbers, glTF has linear light.
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)


def _factor(document: dict[str, Any], primitive: dict[str, Any]) -> Float64Array | None:
    """The material's base color, linear light; None where there is none, or a texture has it."""
    if "material" not in primitive:
        return None
    surface = document["materials"][primitive["material"]].get("pbrMetallicRoughness", {})
    if "baseColorTexture" in surface or "baseColorFactor" not in surface:
        return None
    return np.array(surface["baseColorFactor"][:3], dtype=np.float64).reshape(3)


# The scene graph of a glTF document: which mesh stands where, how often, and how its vertices are moved there.

INSTANCES = "EXT_mesh_gpu_instancing"
VISIBILITY = "KHR_node_visibility"
CENTER = "CESIUM_RTC"


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """A node's mesh. mesh: its number · matrices: (I, 4, 4), from its frame to the scene's, one for each instance ·
    weights: of its morph targets, None: the mesh's own · joints: (J, 4, 4) where a skin moves it, in place of
    ``matrices``."""

    mesh: int
    matrices: Float64Array
    weights: list[float] | None = None
    joints: Float64Array | None = None


def placed_meshes(
    document: dict[str, Any], accessors: Accessors, asked: str | None
) -> tuple[Iterable[PlacedMesh], tuple[str, ...]]:
    """The meshes of the visible nodes, or of the one that is asked for, and what is told of them.

    Raises FieldFormatError (MESH_INVALID) for a graph that is not a tree, INVALID_DESCRIPTION for a name of no node;
    KeyError, TypeError ... for faulty JSON.
    """
    nodes, scenes = document.get("nodes", []), document.get("scenes", [])
    if not nodes:  # meshes that no node places
        nodes = [{"mesh": number, "name": mesh.get("name")} for number, mesh in enumerate(document.get("meshes", []))]
        scenes = []
    if len(nodes) > MAX_NODES:
        raise malformed(f"a glTF scene of {len(nodes)} nodes")
    center = _translation(document.get("extensions", {}).get(CENTER, {}).get("center", (0.0, 0.0, 0.0)))
    roots = scenes[document.get("scene", 0)].get("nodes", []) if scenes else _without_parent(nodes)
    drawn = dict(_visited(nodes, roots, center))
    poses = dict(drawn)
    if any("skin" in nodes[number] for number in drawn):  # a joint may stand in no scene, or be invisible
        poses |= dict(_visited(nodes, _without_parent(nodes), center, hidden=True))
    above = {child: number for number in drawn for child in nodes[number].get("children", [])}
    named, places = Nodes(), dict[int, int]()
    for number in drawn:
        outer = places.get(above.get(number, -1), -1)
        places[number] = named.add(nodes[number].get("name"), outer, "mesh" in nodes[number])
    read, notes = named.chosen(asked)

    def placed(node: dict[str, Any], pose: Float64Array) -> PlacedMesh:
        if type(node["mesh"]) is not int or node["mesh"] < 0:
            raise malformed("a glTF node refers to a mesh that does not exist")
        joints = None if "skin" not in node else _joints(document["skins"][node["skin"]], poses, accessors)
        return PlacedMesh(node["mesh"], pose @ _instances(node, accessors), node.get("weights"), joints)

    shown = (number for number in drawn if "mesh" in nodes[number] and read[places[number]])
    return (placed(nodes[number], drawn[number]) for number in shown), notes


def _visited(
    nodes: list[dict[str, Any]], roots: list[int], above: Float64Array, hidden: bool = False
) -> Iterator[tuple[int, Float64Array]]:
    """The nodes below the roots, and from its frame to the scene's (4, 4). hidden: whether invisible ones too."""
    waiting = [(number, above) for number in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        number, above = waiting.pop()
        if type(number) is not int or not 0 <= number < len(nodes) or number in seen:
            raise malformed("a glTF node has two parents, or none")
        seen.add(number)
        node = nodes[number]
        if not hidden and node.get("extensions", {}).get(VISIBILITY, {}).get("visible", True) is False:
            continue
        matrix = above @ _pose(node)
        yield number, matrix
        waiting.extend((child, matrix) for child in reversed(node.get("children", [])))


def _without_parent(nodes: list[dict[str, Any]]) -> list[int]:
    children = {child for node in nodes for child in node.get("children", [])}
    return [number for number in range(len(nodes)) if number not in children]


def _instances(node: dict[str, Any], accessors: Accessors) -> Float64Array:
    """(I, 4, 4): the places of a node's mesh in the node's frame."""
    said = node.get("extensions", {}).get(INSTANCES)
    if said is None:
        return np.eye(4)[None]
    given = said["attributes"]
    widths = {"TRANSLATION": 3, "ROTATION": 4, "SCALE": 3}
    read = {name: accessors.array(given[name], width) for name, width in widths.items() if name in given}
    counts = {len(values) for values in read.values()}
    if len(counts) != 1:
        raise malformed("glTF instances have different counts, or no translation")
    count = counts.pop()
    require_room(0, count)
    matrices = np.tile(np.eye(4), (count, 1, 1))
    if "ROTATION" in read:
        matrices[:, :3, :3] = _rotations(read["ROTATION"])
    if "SCALE" in read:
        matrices[:, :3, :3] *= read["SCALE"][:, None, :]
    if "TRANSLATION" in read:
        matrices[:, :3, 3] = read["TRANSLATION"]
    return matrices


def _joints(skin: dict[str, Any], poses: dict[int, Float64Array], accessors: Accessors) -> Float64Array:
    """(J, 4, 4): what each joint does to a vertex (glTF 2.0, 3.7.3.3): its pose after the inverse bind matrix."""
    if not all(type(joint) is int and joint in poses for joint in skin["joints"]):
        raise malformed("a glTF skin has a joint that is not a node")
    joints = np.stack([poses[joint] for joint in skin["joints"]])
    if "inverseBindMatrices" not in skin:
        return joints
    binds = accessors.array(skin["inverseBindMatrices"], 16).reshape(-1, 4, 4).transpose(0, 2, 1)
    if len(binds) < len(joints):
        raise malformed("a glTF skin with fewer inverse bind matrices than joints")
    moved: Float64Array = joints @ binds[: len(joints)]
    return moved


def _pose(node: dict[str, Any]) -> Float64Array:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = _translation(node.get("translation", (0.0, 0.0, 0.0)))
    turn = _rotations(np.array(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), dtype=np.float64).reshape(1, 4))[0]
    matrix[:3, :3] = turn * np.array(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64)
    return matrix


def _translation(shift: Any) -> Float64Array:
    matrix = np.eye(4)
    matrix[:3, 3] = shift
    return matrix


def _rotations(quaternions: npt.NDArray[np.float64]) -> Float64Array:
    """(N, 3, 3) of quaternions (N, 4), x, y, z, w, of any length but zero."""
    square = np.square(quaternions).sum(axis=1)
    if not (square > 0.0).all():
        raise malformed("a glTF node or instance has an invalid rotation")
    x, y, z, w = (quaternions / np.sqrt(square)[:, None]).T
    return np.array(rotation_rows(x, y, z, w)).transpose(2, 0, 1)


_HEADER, _CHUNK_HEADER = 12, 8
_JSON, _BIN = b"JSON", b"BIN\0"
_MAX_JSON = 64 << 20
_DENIED = "the min and max of POSITION, which contradict its numbers"
_IGNORED = {"animations": "animations", "images": "textures"}
_APPLIED = frozenset({INSTANCES, VISIBILITY, CENTER, DRACO, *MESHOPT})
_NO_SHAPE = (
    *("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "MSFT_packing_", "ADOBE_materials_"),
    *("KHR_lights_", "EXT_lights_", "KHR_techniques_webgl", "EXT_materials_", "CESIUM_primitive_outline", "VRM"),
    *("KHR_mesh_quantization", "EXT_mesh_manifold", "FB_ngon_encoding", "MSFT_lod", "KHR_xmp", "KHR_animation_"),
    *("EXT_mesh_features", "EXT_instance_features", "EXT_structural_metadata", "EXT_feature_metadata"),
    *("KHR_audio", "MSFT_audio", "KHR_physics_", "OMI_", "KHR_interactivity", "KHR_node_select", "KHR_node_hover"),
)
"""Beginnings of the names of extensions that leave triangles where they are. All others are said."""


def read_glb(data: memoryview, siblings: Siblings | None = None, node: str | None = None) -> Geometry:
    """The triangles of a .glb file's scene. ``siblings``: the files that came with it, by name · node: the one to read.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, FORMAT_NOT_SUPPORTED for unknown extensions,
    MESH_EXTERNAL_REFERENCE for buffers in files that did not come with it, or INVALID_DESCRIPTION for a wrong node.
    """
    document, binary = _chunks(data)
    return _geometry(document, binary, siblings or {}, node)


def read_gltf(data: memoryview, siblings: Siblings | None = None, node: str | None = None) -> Geometry:
    """The triangles of a .gltf file's scene, its buffers within it or beside it. Raises as :func:`read_glb`."""
    return _geometry(_document(data), None, siblings or {}, node)


def gltf_parts(data: memoryview) -> tuple[dict[str, Any], memoryview | None]:
    """The document and the binary chunk of a .glb file, or of a .gltf file, which has none.

    Raises FieldFormatError (MESH_INVALID).
    """
    return _chunks(data) if bytes(data[:4]) == b"glTF" else (_document(data), None)


def _geometry(document: dict[str, Any], binary: memoryview | None, siblings: Siblings, node: str | None) -> Geometry:
    try:
        return _scene(document, Accessors(document, binary, siblings), node)
    except _CONTRADICTIONS as error:
        raise malformed(f"the glTF document contradicts itself ({type(error).__name__})") from error


def _chunks(data: memoryview) -> tuple[dict[str, Any], memoryview]:
    if len(data) < _HEADER + _CHUNK_HEADER or int.from_bytes(data[4:8], "little") != 2:
        raise malformed("a glTF file of another version than 2: convert it to glTF 2.0")
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
    asset = document.get("asset")
    if str(asset.get("version", "2.0") if isinstance(asset, dict) else "2.0").startswith("1."):
        raise malformed("a glTF file of another version than 2: convert it to glTF 2.0")
    return document


def _scene(document: dict[str, Any], accessors: Accessors, asked: str | None) -> Geometry:
    required, used = (
        [str(name)[:60] for name in document.get(key, []) if not str(name).startswith(_NO_SHAPE)]
        for key in ("extensionsRequired", "extensionsUsed")
    )
    if unknown := [name for name in required if name not in _APPLIED]:
        raise unsupported(f"the glTF file needs the extension {unknown[0]}, which is not read: export it without")
    flat: set[str] = set()
    placed, notes = placed_meshes(document, accessors, asked)
    doubts: set[str] = set()
    found = assembled(_parts(document, accessors, placed, flat, doubts), notes=notes)
    return replace(
        found,
        left_out=(*sorted(flat), *(word for key, word in _IGNORED.items() if document.get(key))),
        not_applied=(*(f"extension {name}" for name in used if name not in _APPLIED), *sorted(doubts)),
        assumes=GLTF,
    )


def _parts(
    document: dict[str, Any], accessors: Accessors, placed: Iterable[PlacedMesh], flat: set[str], doubts: set[str]
) -> Iterator[Part]:
    """The triangles of each primitive of the meshes, at their places; what else there is goes to ``flat``."""
    for one in placed:
        mesh = document["meshes"][one.mesh]
        for primitive in mesh["primitives"]:
            if (mode := primitive.get("mode", _TRIANGLES)) not in (_TRIANGLES, _STRIP, _FAN):
                flat.add("points" if mode == 0 else "lines")
                continue
            if "POSITION" not in primitive["attributes"]:
                flat.add("parts without positions")
                continue
            accessors.unpack(primitive)
            if accessors.denies(primitive["attributes"]["POSITION"]):
                doubts.add(_DENIED)
            places = _morphed(primitive, one.weights or mesh.get("weights"), accessors)
            corners = _triangles(primitive, accessors, len(places))
            painted = _primitive_colors(document, primitive, accessors, len(places))
            if one.joints is None:
                yield Part(places, corners, one.matrices, painted)
            else:
                yield Part(_skinned(places, primitive, one.joints, accessors), corners, colors=painted)


def _morphed(primitive: dict[str, Any], weights: list[float] | None, accessors: Accessors) -> Float64Array:
    """The places (V, 3) with the morph targets at these weights."""
    places = accessors.array(primitive["attributes"]["POSITION"], 3)
    for weight, target in zip(weights or (), primitive.get("targets", []), strict=False):
        if weight != 0.0 and "POSITION" in target:
            moved = accessors.array(target["POSITION"], 3)
            if len(moved) != len(places):
                raise malformed("a glTF morph target has another number of vertices")
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
            raise malformed("a glTF skin has another number of vertices, or a joint that does not exist")
        for column in range(4):
            blended += weights[:, column, None, None] * joints[chosen[:, column]]
        total += weights.sum(axis=1)
    if not (total > 0.0).all():
        raise malformed("a glTF vertex has no joint in its skin")
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
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    return fan(order) if mode == _FAN else strips(order)
