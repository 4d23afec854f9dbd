"""The scene of a COLLADA file: which geometry stands where."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from regnf_core.importing.meshes.geometry import Float64Array, elsewhere, malformed
from regnf_core.importing.meshes.number_text import numbers_of
from regnf_core.importing.meshes.xml_tree import Element

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
