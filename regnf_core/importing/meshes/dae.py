"""COLLADA (.dae): the polygons of the scene's geometries at their nodes' poses, skins at their bind shape."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat

import numpy as np

from regnf_core.importing.meshes.point_files import numbers_of
from regnf_core.importing.meshes.triangle_files import (
    MAX_TRIANGLES,
    MAX_VERTICES,
    Float64Array,
    Geometry,
    Int64Array,
    elsewhere,
    fan,
    fans,
    malformed,
    require_room,
    strips,
)

# XML as a plain tree: elements, attributes, text. No document type, so no entities; nothing outside is ever opened.

_MAX_TREE_DEPTH, _MAX_ELEMENTS = 256, 500_000


@dataclass(eq=False)
class Element:
    """``name`` is without its namespace; ``text`` is what stands directly within."""

    name: str
    attributes: dict[str, str]
    children: list[Element] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        return "".join(self.texts)

    def all(self, *names: str) -> Iterator[Element]:
        """The children of these names, in their order."""
        return (child for child in self.children if child.name in names)

    def first(self, *path: str) -> Element | None:
        """The first element down this path of names."""
        here: Element | None = self
        for name in path:
            here = next(here.all(name), None) if here is not None else None
        return here


class _Builder:
    def __init__(self) -> None:
        self.root = Element("", {})
        self._open = [self.root]
        self._elements = 0

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self._elements += 1
        if len(self._open) > _MAX_TREE_DEPTH or self._elements > _MAX_ELEMENTS:
            raise malformed("the XML file nests too deep, or has too many elements")
        element = Element(name.rpartition(":")[2], attributes)
        self._open[-1].children.append(element)
        self._open.append(element)

    def end(self, _name: str) -> None:
        self._open.pop()

    def text(self, text: str) -> None:
        self._open[-1].texts.append(text)


def read_xml(data: memoryview) -> Element:
    """An element that holds the document's. Raises FieldFormatError (MESH_INVALID)."""
    builder = _Builder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.text
    parser.StartDoctypeDeclHandler = _refuse
    parser.EntityDeclHandler = _refuse
    parser.ExternalEntityRefHandler = _refuse
    try:
        parser.Parse(bytes(data), True)
    except expat.ExpatError as error:
        raise malformed(f"the XML file is malformed: {expat.ErrorString(error.code)}") from error
    except (LookupError, ValueError) as error:  # an encoding that expat asks Python for
        raise malformed("the XML file has an encoding that is not known") from error
    return builder.root


def _refuse(*_: object) -> Any:
    raise malformed("the XML file declares a document type or entities, which no mesh needs")


# The scene of a COLLADA file: which geometry stands where.

_MAX_NODES, _MAX_DEPTH = 100_000, 64
_SIZES = {"matrix": 16, "translate": 3, "scale": 3, "rotate": 4, "lookat": 9, "skew": 7}


def target(reference: str | None, among: Sequence[Element]) -> Element:
    """The element that ``#id`` names. Raises FieldFormatError: MESH_EXTERNAL_REFERENCE or MESH_INVALID."""
    if reference is None or not reference.startswith("#"):
        raise elsewhere("the COLLADA file keeps a part in another file or address: export it as one file")
    found = next((element for element in among if element.attributes.get("id") == reference[1:]), None)
    if found is None:
        raise malformed("the COLLADA file names a part that it does not have")
    return found


def placed_geometries(collada: Element) -> Iterator[tuple[str, Element, Float64Array]]:
    """Every geometry of the scene: its name, itself, and the (4, 4) matrix from its frame to the scene's.

    Raises FieldFormatError (MESH_INVALID) for nodes that lead in a circle, or too many.
    """
    geometries = [each for library in collada.all("library_geometries") for each in library.all("geometry")]
    by_name = {each.attributes.get("id", ""): each for each in geometries}
    controllers = [each for library in collada.all("library_controllers") for each in library.all("controller")]
    shared = [node for library in collada.all("library_nodes") for node in library.all("node")]
    waiting = [(node, np.eye(4), 0) for node in reversed(_roots(collada))]
    if not waiting:  # geometries that no node places
        yield from ((name, each, np.eye(4)) for name, each in by_name.items())
        return
    visited = 0
    while waiting:
        node, above, depth = waiting.pop()
        visited += 1
        if depth > _MAX_DEPTH or visited > _MAX_NODES:
            raise malformed("the COLLADA file's nodes lead in a circle, nest too deep, or are too many")
        matrix = above @ _pose(node)
        for instance in node.all("instance_geometry"):
            url = instance.attributes.get("url", "")
            found = by_name.get(url[1:]) if url.startswith("#") else None
            yield url, found if found is not None else target(url, geometries), matrix
        for instance in node.all("instance_controller"):
            controller, placed = target(instance.attributes.get("url"), controllers), matrix
            for _ in range(_MAX_DEPTH):  # a skin of a morph of a mesh
                skin = controller.first("skin")
                held = skin or controller.first("morph")
                if held is None:
                    raise malformed("a COLLADA controller that is neither a skin nor a morph")
                placed = placed if skin is None else _bind_shape(skin)
                url = held.attributes.get("source", "")
                if (found := by_name.get(url.removeprefix("#"))) is not None:
                    yield url, found, placed
                    break
                controller = target(url, controllers)
        waiting.extend((child, matrix, depth + 1) for child in node.all("node"))
        for instance in node.all("instance_node"):
            waiting.append((target(instance.attributes.get("url"), shared), matrix, depth + 1))


def _bind_shape(held: Element) -> Float64Array:
    """From a mesh's frame to that of the skeleton at rest; a skin's mesh is not moved by its node."""
    said = held.first("bind_shape_matrix")
    numbers = np.eye(4).reshape(-1) if said is None else numbers_of(said.text.encode("ascii", "replace"), "COLLADA")
    if len(numbers) != 16:
        raise malformed("a COLLADA bind shape matrix has another number of values")
    return numbers.reshape(4, 4)


def _roots(collada: Element) -> list[Element]:
    scenes = [each for library in collada.all("library_visual_scenes") for each in library.all("visual_scene")]
    instance = collada.first("scene", "instance_visual_scene")
    if instance is not None:
        return list(target(instance.attributes.get("url"), scenes).all("node"))
    return list(scenes[0].all("node")) if scenes else []


def _pose(node: Element) -> Float64Array:
    """The node's transforms in their order, each applied before those above it."""
    matrix = np.eye(4)
    for child in node.all(*_SIZES):
        numbers = numbers_of(child.text.encode("ascii", "replace"), "COLLADA")
        if len(numbers) != _SIZES[child.name]:
            raise malformed(f"a COLLADA node's {child.name} has another number of values")
        matrix = matrix @ _transform(child.name, numbers)
    return matrix


def _transform(name: str, numbers: Float64Array) -> Float64Array:
    matrix = np.eye(4)
    if name == "matrix":
        matrix = numbers.reshape(4, 4)
    elif name == "translate":
        matrix[:3, 3] = numbers
    elif name == "scale":
        matrix[:3, :3] = np.diag(numbers)
    elif name == "rotate":
        matrix[:3, :3] = _rotation(numbers[:3], np.radians(numbers[3]))
    else:
        raise malformed(f"a COLLADA node with a {name}, which is not taken")
    return matrix


def _rotation(axis: Float64Array, angle: float) -> Float64Array:
    """Rodrigues' formula."""
    length = float(np.linalg.norm(axis))
    if not length > 0.0:
        raise malformed("a COLLADA node turned about no axis")
    x, y, z = axis / length
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: Float64Array = np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
    return turn


_FACES = ("triangles", "polylist", "polygons", "trifans", "tristrips")
_IGNORED = {"library_animations": "animations", "library_images": "textures"}
_USUAL_UNIT = 1.0


def read_dae(data: memoryview) -> Geometry:
    """The triangles of a COLLADA file's scene, in the file's own unit and axes.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, or MESH_EXTERNAL_REFERENCE for parts in other files.
    """
    collada = read_xml(data).first("COLLADA")
    if collada is None:
        raise malformed("an XML file, but not COLLADA")
    vertices: list[Float64Array] = [np.zeros((0, 3))]
    faces: list[Int64Array] = [np.zeros((0, 3), np.int64)]
    read: dict[str, tuple[Float64Array, Int64Array]] = {}
    so_far = triangles = 0
    for name, geometry, matrix in placed_geometries(collada):
        if name not in read:
            read[name] = _mesh(geometry)
        places, corners = read[name]
        turned = np.linalg.det(matrix[:3, :3]) < 0  # a mirrored node turns its faces round
        vertices.append(places @ matrix[:3, :3].T + matrix[:3, 3])
        faces.append((corners[:, ::-1] if turned else corners) + so_far)
        so_far, triangles = so_far + len(places), triangles + len(corners)
        require_room(so_far, triangles)
    return Geometry(
        np.concatenate(vertices), np.concatenate(faces), left_out=_left_out(collada), not_applied=_not_applied(collada)
    )


def _mesh(geometry: Element) -> tuple[Float64Array, Int64Array]:
    """Places (V, 3) and triangles (F, 3) of one geometry; none of one that is no mesh, for instance a spline."""
    mesh = geometry.first("mesh")
    if mesh is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    places: dict[int, Float64Array] = {}
    starts: dict[int, int] = {}
    found: list[Int64Array] = [np.zeros((0, 3), np.int64)]
    so_far = 0
    for part in mesh.all(*_FACES):
        corners, source = _triangles(mesh, part)
        if id(source) not in places:
            places[id(source)], starts[id(source)] = _places(source), so_far
            so_far += len(places[id(source)])
        if len(corners) and (corners.min() < 0 or corners.max() >= len(places[id(source)])):
            raise malformed("a COLLADA face names a vertex that does not exist")
        found.append(corners + starts[id(source)])
        require_room(so_far, sum(map(len, found)))
    return np.concatenate([np.zeros((0, 3)), *places.values()]), np.concatenate(found)


def _triangles(mesh: Element, part: Element) -> tuple[Int64Array, Element]:
    """The triangles of one list of faces, and the source of its places."""
    inputs = list(part.all("input"))
    vertex = next((each for each in inputs if each.attributes.get("semantic") == "VERTEX"), None)
    if vertex is None:
        raise malformed("COLLADA faces without vertices")
    offsets = [_count(each.attributes.get("offset"), 63) for each in inputs]
    offset, width = _count(vertex.attributes.get("offset"), 63), max(offsets) + 1
    lists = [_indices(p, offset, width) for p in _index_lists(part)]
    require_room(0, sum(map(len, lists)))
    return _cut(part, lists), _position(mesh, vertex)


def _index_lists(part: Element) -> list[Element]:
    """The lists of indices, also of polygons with holes, whose holes are ignored."""
    holed = [p for ph in part.all("ph") for p in ph.all("p")]
    return [*part.all("p"), *holed]


def _indices(p: Element, offset: int, width: int) -> Int64Array:
    numbers = _whole(numbers_of(p.text.encode("ascii", "replace"), "COLLADA"))
    if len(numbers) % width:
        raise malformed("a COLLADA list of indices that ends within a corner")
    return numbers[offset::width]


def _cut(part: Element, lists: list[Int64Array]) -> Int64Array:
    empty = np.zeros((0, 3), np.int64)
    if part.name == "triangles":
        order = np.concatenate([*lists, np.zeros(0, np.int64)])
        if len(order) % 3:
            raise malformed("COLLADA triangles without three corners")
        return order.reshape(-1, 3)
    if part.name == "tristrips":
        return np.concatenate([empty, *(strips(order) for order in lists)])
    if part.name == "polylist":
        counts, order = _vertex_counts(part), np.concatenate([*lists, np.zeros(0, np.int64)])
        if counts.sum() != len(order):
            raise malformed("a COLLADA list of polygons of another length than it says")
        if (counts == 3).all() or (counts == 4).all():
            return fans(order.reshape(len(counts), -1)) if len(counts) else empty
        lists = np.split(order, np.cumsum(counts)[:-1])
    return np.concatenate([empty, *(fan(order) for order in lists)])


def _vertex_counts(part: Element) -> Int64Array:
    vcount = part.first("vcount")
    counts = _whole(numbers_of((vcount.text if vcount else "").encode("ascii", "replace"), "COLLADA"))
    if len(counts) and (counts.min() < 0 or counts.max() > MAX_TRIANGLES):
        raise malformed("a COLLADA polygon of no possible number of corners")
    return counts


def _position(mesh: Element, vertex: Element) -> Element:
    """The source of the places that an input of the semantic VERTEX leads to."""
    vertices = target(vertex.attributes.get("source"), list(mesh.all("vertices")))
    for each in vertices.all("input"):
        if each.attributes.get("semantic") == "POSITION":
            return target(each.attributes.get("source"), list(mesh.all("source")))
    raise malformed("COLLADA vertices without places")


def _places(source: Element) -> Float64Array:
    """The rows (V, 3) that the source's accessor takes from its numbers."""
    array, accessor = source.first("float_array"), source.first("technique_common", "accessor")
    if array is None or accessor is None:
        raise malformed("COLLADA places without numbers")
    numbers = numbers_of(array.text.encode("ascii", "replace"), "COLLADA")
    count = _count(accessor.attributes.get("count"), MAX_VERTICES)
    stride = _count(accessor.attributes.get("stride", "1"), 1 << 16)
    offset = _count(accessor.attributes.get("offset"), len(numbers))
    if stride < 3 or offset + stride * max(count - 1, 0) + 3 * min(count, 1) > len(numbers):
        raise malformed("a COLLADA accessor reaches beyond its numbers")
    step = numbers.strides[0]
    return np.ndarray((count, 3), np.float64, numbers.copy(), offset * step, (stride * step, step)).copy()


def _count(text: str | None, most: int) -> int:
    if text is None:
        return 0
    if not text.isascii() or not text.isdigit() or len(text) > 12 or int(text) > most:
        raise malformed("a COLLADA count that is not a number, or too large")
    return int(text)


def _whole(numbers: Float64Array) -> Int64Array:
    if not (np.isfinite(numbers) & (np.abs(numbers) < 2.0**53)).all():
        raise malformed("a COLLADA index that is not a number")
    return numbers.astype(np.int64)


def _left_out(collada: Element) -> tuple[str, ...]:
    parts = [word for name, word in _IGNORED.items() if (found := collada.first(name)) and found.children]
    unit = collada.first("asset", "unit")
    meters = unit.attributes.get("meter", "1") if unit is not None else "1"
    try:
        if float(meters) != _USUAL_UNIT:
            parts.append(f"that its unit is {float(meters):g} m: say world_scale for a field in meters")
    except ValueError:
        parts.append("a unit that is not a number")
    return tuple(parts)


def _not_applied(collada: Element) -> tuple[str, ...]:
    controllers = [each for library in collada.all("library_controllers") for each in library.all("controller")]
    geometries = [each for library in collada.all("library_geometries") for each in library.all("geometry")]
    meshes = [mesh for each in geometries for mesh in each.all("mesh")]
    holed = sum(1 for mesh in meshes for part in mesh.all("polygons") for _ in part.all("ph"))
    counts = {
        "morphs": sum(1 for each in controllers for _ in each.all("morph")),
        "poses of skins, which stand at their bind shape": sum(1 for each in controllers for _ in each.all("skin")),
        "polygons' holes": holed,
        "geometries that are no mesh": len(geometries) - len(meshes),
    }
    return tuple(f"{count} {what}" for what, count in counts.items() if count > 0)
