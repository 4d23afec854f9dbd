"""The scene graph of a glTF document: which mesh stands where."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from regnf_core.importing.meshes.geometry import Float64Array, malformed

_MAX_NODES = 100_000


def placed_meshes(document: dict[str, Any]) -> Iterator[tuple[int, Float64Array]]:
    """Every node's mesh: its number, and the (4, 4) matrix from its frame to the scene's.

    Raises FieldFormatError (MESH_INVALID) for a graph that is not a tree; KeyError, TypeError ... for faulty JSON.
    """
    nodes = document.get("nodes", [])
    if not nodes:  # meshes that no node places
        yield from ((number, np.eye(4)) for number in range(len(document.get("meshes", []))))
        return
    if len(nodes) > _MAX_NODES:
        raise malformed(f"a glTF scene of {len(nodes)} nodes")
    waiting = [(number, np.eye(4)) for number in _roots(document, nodes)]
    seen: set[int] = set()
    while waiting:
        number, above = waiting.pop()
        if type(number) is not int or not 0 <= number < len(nodes) or number in seen:
            raise malformed("a glTF node stands in two places, or nowhere")
        seen.add(number)
        node = nodes[number]
        matrix = above @ _pose(node)
        if "mesh" in node:
            if type(node["mesh"]) is not int or node["mesh"] < 0:
                raise malformed("a glTF node of no mesh")
            yield node["mesh"], matrix
        waiting.extend((child, matrix) for child in node.get("children", []))


def _roots(document: dict[str, Any], nodes: list[dict[str, Any]]) -> list[int]:
    scenes = document.get("scenes", [])
    if scenes:
        roots: list[int] = scenes[document.get("scene", 0)].get("nodes", [])
        return roots
    children = {child for node in nodes for child in node.get("children", [])}
    return [number for number in range(len(nodes)) if number not in children]


def _pose(node: dict[str, Any]) -> Float64Array:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = np.array(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), dtype=np.float64)
    length = x * x + y * y + z * z + w * w
    if not length > 0.0:
        raise malformed("a glTF node turned by no rotation")
    s = 2.0 / length
    turn = [
        [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
    ]
    matrix[:3, :3] = np.array(turn) * np.array(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix
