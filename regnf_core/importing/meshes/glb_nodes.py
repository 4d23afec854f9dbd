"""The scene graph of a glTF document: which mesh stands where, how often, and how its vertices are moved there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.importing.meshes.geometry import Float64Array, malformed, require_room
from regnf_core.importing.meshes.glb_buffers import Accessors

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
    drawn = dict(_visited(nodes, _roots(document, nodes), center))
    poses = dict(drawn)
    if any("skin" in nodes[number] for number in drawn):  # a joint may stand in no scene, or be invisible
        poses |= dict(_visited(nodes, _without_parent(nodes), center, hidden=True))
    for number, pose in drawn.items():
        node = nodes[number]
        if "mesh" not in node:
            continue
        if type(node["mesh"]) is not int or node["mesh"] < 0:
            raise malformed("a glTF node of no mesh")
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
            raise malformed("a glTF node stands in two places, or nowhere")
        seen.add(number)
        node = nodes[number]
        if not hidden and node.get("extensions", {}).get(VISIBILITY, {}).get("visible", True) is False:
            continue
        matrix = above @ _pose(node)
        yield number, matrix
        waiting.extend((child, matrix) for child in node.get("children", []))


def _roots(document: dict[str, Any], nodes: list[dict[str, Any]]) -> list[int]:
    scenes = document.get("scenes", [])
    if scenes:
        roots: list[int] = scenes[document.get("scene", 0)].get("nodes", [])
        return roots
    return _without_parent(nodes)


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
        raise malformed("glTF instances of different counts, or without any place")
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
        raise malformed("a glTF skin has a joint that is no node")
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
        raise malformed("a glTF node or instance turned by no rotation")
    x, y, z, w = (quaternions / np.sqrt(square)[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)
