"""glTF 2.0, binary or text: the triangles of all nodes and instances at their poses, skins at rest, morph targets at
their default weights, with their vertices' or materials' colors. Textures are ignored; every extension that may change
the shape and is not applied is said.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.assumptions import GLTF
from regnf_core.importing.meshes.triangle_files import (
    MAX_TRIANGLES,
    Float64Array,
    Geometry,
    Int64Array,
    Siblings,
    elsewhere,
    fan,
    malformed,
    require_room,
    strips,
    unsupported,
    within_unit,
)
from regnf_core.rotations import rotation_rows

# The numbers: accessors into buffers, every extent checked first. A buffer is the file's own binary chunk, text within
# the document, or a file that came with it. None is ever looked for.

_CONTRADICTIONS = (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError)
"""What faulty JSON ends in, where no check says more."""
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_MAX_ITEMS = 3 * MAX_TRIANGLES
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


class Accessors:
    """Reads accessors of ``document``. binary: the file's chunk, None in text form · siblings: files beside it."""

    def __init__(self, document: dict[str, Any], binary: memoryview | None, siblings: Siblings) -> None:
        self._accessors, self._views, self._buffers = (
            document.get(key, []) for key in ("accessors", "bufferViews", "buffers")
        )
        self._binary = binary
        self._siblings = siblings
        self._read: dict[int, memoryview] = {}

    def array(self, number: object, width: int) -> Float64Array:
        """The items (N, width) of accessor ``number``.

        Raises FieldFormatError: MESH_INVALID, FORMAT_NOT_SUPPORTED or MESH_EXTERNAL_REFERENCE.
        """
        accessor = self._accessors[_whole(number)]
        component = _COMPONENTS.get(accessor["componentType"])
        if component is None or _WIDTHS.get(accessor["type"]) != width:
            raise malformed("a glTF accessor of an unexpected type")
        count = _whole(accessor["count"])
        if count > _MAX_ITEMS:
            raise malformed(f"a glTF accessor of {count} items")
        items = np.zeros((count, width))
        if "bufferView" in accessor:
            items = self._items(accessor, component, count, width)
        if "sparse" in accessor:
            said = accessor["sparse"]
            changed, type_ = _whole(said["count"]), _COMPONENTS.get(said["indices"]["componentType"])
            if type_ is None or type_[1] != "u" or changed > count:
                raise malformed("a glTF sparse accessor has too many items")
            at = self._items(said["indices"], type_, changed, 1).reshape(-1).astype(np.int64)
            if len(at) and at.max() >= count:
                raise malformed("a glTF sparse accessor refers to an item that does not exist")
            items[at] = self._items(said["values"], component, changed, width)
        if accessor.get("normalized", False) and component != "<f4":
            items = np.maximum(items / float(np.iinfo(np.dtype(component)).max), -1.0)
        return items

    def denies(self, number: object) -> bool:
        """Whether the lowest and highest corner that an accessor states are not those of its numbers (N, 3)."""
        accessor = self._accessors[_whole(number)]
        told = "bufferView" in accessor and "sparse" not in accessor and "min" in accessor and "max" in accessor
        if not told or not accessor["count"] or accessor.get("normalized"):
            return False
        items, stated = self.array(number, 3), np.array([accessor["min"], accessor["max"]], np.float64)
        found = np.stack([items.min(axis=0), items.max(axis=0)])
        return bool(np.abs(found - stated).max() > _DENIED_BY * np.abs(stated).max())

    def is_stored(self, number: object) -> bool:
        """Whether accessor ``number`` has numbers of its own."""
        accessor = self._accessors[_whole(number)]
        return "bufferView" in accessor or "sparse" in accessor

    def _items(self, said: dict[str, Any], component: str, count: int, width: int) -> Float64Array:
        """(count, width) numbers of a buffer view, from a byte offset on."""
        view, item = self._views[_whole(said["bufferView"])], np.dtype(component).itemsize * width
        data = self._view(view)
        stride, start = _whole(view.get("byteStride", item)), _whole(said.get("byteOffset", 0))
        if stride < item or start + stride * max(count - 1, 0) + item * min(count, 1) > len(data):
            raise malformed("a glTF accessor extends beyond its buffer view")
        items = np.ndarray((count, width), component, data, start, (stride, np.dtype(component).itemsize))
        return items.astype(np.float64)

    def _view(self, view: dict[str, Any]) -> memoryview:
        if any(name in view.get("extensions", {}) for name in COMPRESSED):
            raise unsupported("the glTF file's buffers are compressed: export it without mesh compression")
        data = self._buffer(_whole(view["buffer"]))
        start, size = _whole(view.get("byteOffset", 0)), _whole(view["byteLength"])
        if start + size > len(data):
            raise malformed("a glTF buffer view extends beyond its buffer")
        return data[start : start + size]

    def _buffer(self, number: int) -> memoryview:
        """The bytes of a buffer, no more than it claims."""
        if number not in self._read:
            buffer = self._buffers[number]
            claimed = _whole(buffer["byteLength"])
            if "uri" in buffer:
                data = self._elsewhere(buffer["uri"], claimed)
            elif number == 0 and self._binary is not None:
                data = self._binary
            else:
                raise malformed("a glTF buffer without data")
            self._read[number] = data[: min(len(data), claimed)]
        return self._read[number]

    def _elsewhere(self, uri: object, claimed: int) -> memoryview:
        """The bytes that a buffer's ``uri`` holds, or that came under this name."""
        if not isinstance(uri, str):
            raise malformed("a glTF buffer's uri is not text")
        if uri.startswith("data:"):
            head, comma, text = uri.partition(",")
            if not comma or not head.endswith(";base64") or len(text) * 3 // 4 > claimed + 3:
                raise malformed("a glTF buffer's data is not base64 of the length that it claims")
            try:
                return memoryview(base64.b64decode(text, validate=True))
            except ValueError as error:
                raise malformed("a glTF buffer's data is not base64") from error
        name = unquote(uri).removeprefix("./")
        if name not in self._siblings:
            missing = "the glTF file keeps its geometry in another file or address: "
            raise elsewhere(missing + "give both in one archive, or export it as one .glb")
        return self._siblings[name]


def _whole(value: object) -> int:
    if type(value) is not int or not 0 <= value < 1 << 48:
        raise malformed("a glTF count, offset or index that is not a number")
    return value


# The colors of a glTF document's vertices: their own times the material's, linear light as sRGB. No textures.

_GRAY = 0.8
"""Of parts without any color, beside others that have one."""


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
_MAX_NODES = 100_000


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """A node's mesh. mesh: its number · matrices: (I, 4, 4), from its frame to the scene's, one for each instance ·
    weights: of its morph targets, None: the mesh's own · joints: (J, 4, 4) where a skin moves it, in place of
    ``matrices``."""

    mesh: int
    matrices: Float64Array
    weights: list[float] | None = None
    joints: Float64Array | None = None


def placed_meshes(document: dict[str, Any], accessors: Accessors) -> Iterator[PlacedMesh]:
    """Every visible node's mesh.

    Raises FieldFormatError (MESH_INVALID) for a graph that is not a tree; KeyError, TypeError ... for faulty JSON.
    """
    nodes = document.get("nodes", [])
    if not nodes:  # meshes that no node places
        yield from (PlacedMesh(number, np.eye(4)[None]) for number in range(len(document.get("meshes", []))))
        return
    if len(nodes) > _MAX_NODES:
        raise malformed(f"a glTF scene of {len(nodes)} nodes")
    center = _translation(document.get("extensions", {}).get(CENTER, {}).get("center", (0.0, 0.0, 0.0)))
    scenes = document.get("scenes", [])
    roots = scenes[document.get("scene", 0)].get("nodes", []) if scenes else _without_parent(nodes)
    drawn = dict(_visited(nodes, roots, center))
    poses = dict(drawn)
    if any("skin" in nodes[number] for number in drawn):  # a joint may stand in no scene, or be invisible
        poses |= dict(_visited(nodes, _without_parent(nodes), center, hidden=True))
    for number, pose in drawn.items():
        node = nodes[number]
        if "mesh" not in node:
            continue
        if type(node["mesh"]) is not int or node["mesh"] < 0:
            raise malformed("a glTF node refers to a mesh that does not exist")
        joints = None if "skin" not in node else _joints(document["skins"][node["skin"]], poses, accessors)
        yield PlacedMesh(node["mesh"], pose @ _instances(node, accessors), node.get("weights"), joints)


def _visited(
    nodes: list[dict[str, Any]], roots: list[int], above: Float64Array, hidden: bool = False
) -> Iterator[tuple[int, Float64Array]]:
    """The nodes below the roots, and from its frame to the scene's (4, 4). hidden: whether invisible ones too."""
    waiting = [(number, above) for number in roots]
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
        waiting.extend((child, matrix) for child in node.get("children", []))


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
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_DENIED, _DENIED_BY = "the min and max of POSITION, which contradict its numbers", 1e-3
"""Said where they differ by so large a share of the largest of them."""
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
    except _CONTRADICTIONS as error:
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
    denied = False
    for placed in placed_meshes(document, accessors):
        mesh = document["meshes"][placed.mesh]
        for primitive in mesh["primitives"]:
            if (mode := primitive.get("mode", _TRIANGLES)) not in (_TRIANGLES, _STRIP, _FAN):
                flat.add("points" if mode == 0 else "lines")
                continue
            _require_plain(primitive, accessors)
            places = _morphed(primitive, placed.weights or mesh.get("weights"), accessors)
            denied = denied or accessors.denies(primitive["attributes"]["POSITION"])
            corners = _triangles(primitive, accessors, len(places))
            if len(corners) and (corners.min() < 0 or corners.max() >= len(places)):
                raise malformed("a glTF face refers to a vertex that does not exist")
            painted = _primitive_colors(document, primitive, accessors, len(places))
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
    parts = zip(colors, vertices, strict=True)
    shown = [np.full((len(part), 3), _GRAY) if color is None else color for color, part in parts]
    return Geometry(
        np.concatenate([empty, *vertices]),
        np.concatenate([empty.astype(np.int64), *faces]),
        colors=None if all(color is None for color in colors) else np.concatenate(shown),
        left_out=(*sorted(flat), *(word for key, word in _IGNORED.items() if document.get(key))),
        not_applied=(*(f"extension {name}" for name in used if name not in _APPLIED), *([_DENIED] if denied else [])),
        assumes=GLTF,
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
        if len(order) % 3:
            raise malformed("glTF triangles without three corners")
        return order.reshape(-1, 3)
    return fan(order) if mode == _FAN else strips(order)
