"""COLLADA (.dae): the polygons of the scene's geometries at their nodes' poses, skins at their bind shape."""

from __future__ import annotations

import numpy as np

from regnf_core.importing.meshes.dae_nodes import placed_geometries, target
from regnf_core.importing.meshes.geometry import (
    MAX_TRIANGLES,
    MAX_VERTICES,
    Float64Array,
    Geometry,
    Int64Array,
    fan,
    fans,
    malformed,
    require_room,
    strips,
)
from regnf_core.importing.meshes.number_text import numbers_of
from regnf_core.importing.meshes.xml_tree import Element, read_xml

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
