"""URDF robots whose links do not move against each other: meshes and basic shapes at their poses, in meters."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from xml.etree.ElementTree import Element

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.assumptions import METERS, SCENE
from regnf_core.importing.containers.sniff import HEAD_BYTES, MESH_FORMATS, explain_refusal, sniff_format
from regnf_core.importing.meshes.scene import Nodes, Part, PlainXml, assembled, parsed, solid
from regnf_core.importing.meshes.triangle_files import (
    Float64Array,
    Geometry,
    Siblings,
    elsewhere,
    malformed,
    unsupported,
)

Read = Callable[[str, memoryview], Geometry]

_SHAPES = ("visual", "collision")
"""Of a link, the first kind that it has is read."""
_SIZES = {"box": (("size", 3),), "cylinder": (("radius", 1), ("length", 1)), "sphere": (("radius", 1),)}
"""Basic shapes, and the attributes that have their sizes, of so many numbers each."""


def read_urdf(data: memoryview, siblings: Siblings, node: str | None, read: Read) -> Geometry:
    """The triangles of all links. siblings: the mesh files by the names that the robot gives them · node: the link to
    read, with those that are joined to it; then joints may move, and are at zero · read: reads a mesh of a format.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, MESH_EXTERNAL_REFERENCE for a mesh that did not come with it,
    FORMAT_NOT_SUPPORTED for moving joints, xacro, or a mesh in a format that is not read, INVALID_DESCRIPTION.
    """
    robot, nodes = _robot(data), Nodes()
    links = {link.get("name", ""): link for link in robot.findall("link")}
    moving = [joint for joint in robot.findall("joint") if joint.get("type") != "fixed"]
    if moving and node is None:
        message = f"a URDF robot with moving joints, such as {moving[0].get('name', '')[:60]}, is no rigid object"
        hint = "Give the mesh of one link, or choose a link by the import option node."
        raise FieldFormatError(message, reason="FORMAT_NOT_SUPPORTED", hint=hint)
    placed = list(_tree(robot, links))
    for name, above, _ in placed:
        nodes.add(name, above, len(_shapes(links[name])))
    chosen, notes = nodes.chosen(node)
    meshes: dict[str, Geometry] = {}
    parts = (
        _part(shape, pose, siblings, meshes, read)
        for number, (name, _, pose) in enumerate(placed)
        if chosen[number]
        for shape in _shapes(links[name])
    )
    return assembled(parts, assumes=(METERS, SCENE), notes=notes)


def mesh_names(data: memoryview) -> list[str]:
    """The names that a robot gives the files of its meshes. Raises FieldFormatError (MESH_INVALID)."""
    return sorted({mesh.get("filename", "") for mesh in _robot(data).iter("mesh")})


def endings(name: str) -> Iterator[str]:
    """How the path of the file of this name may end, the longest first: a package may be anywhere."""
    parts = [part for part in re.sub(r"^\w+://", "", name).split("/") if part not in ("", ".", "..")]
    return ("/".join(parts[start:]) for start in range(len(parts)))


def _robot(data: memoryview) -> Element:
    robot: Element = parsed(data, PlainXml())
    if robot.tag != "robot":
        raise malformed("the URDF file has no robot")
    if any("xacro" in element.tag for element in robot.iter()):
        raise unsupported("a URDF file with xacro macros: expand them first (xacro robot.urdf.xacro > robot.urdf)")
    return robot


def _tree(robot: Element, links: dict[str, Element]) -> Iterator[tuple[str, int, Float64Array]]:
    """The links, each after that which it is joined to: its name, the place in this order of the one above, -1: none,
    and its pose (4, 4)."""
    below: dict[str, list[tuple[str, Float64Array]]] = defaultdict(list)
    children = set()
    for joint in robot.findall("joint"):
        parent, child = (_child(joint, name).get("link", "") for name in ("parent", "child"))
        if not {parent, child} <= links.keys() or child in children:
            raise malformed("a URDF joint of a link that does not exist, or that has another joint")
        children.add(child)
        below[parent].append((child, _origin(joint)))
    waiting = [(name, -1, np.eye(4)) for name in links if name not in children]
    for number, (name, above, pose) in enumerate(waiting):
        yield name, above, pose
        waiting.extend((child, number, pose @ local) for child, local in below[name])
    if len(waiting) < len(links):
        raise malformed("URDF joints in a circle")


def _shapes(link: Element) -> list[Element]:
    return next((found for kind in _SHAPES if (found := link.findall(kind))), [])


def _child(element: Element, name: str) -> Element:
    if (found := element.find(name)) is None:
        raise malformed(f"a URDF {element.tag[:20]} without {name}")
    return found


def _numbers(element: Element, name: str, count: int, default: str | None = None) -> Float64Array:
    try:
        return np.array((element.get(name, default) or "").split(), np.float64).reshape(count)
    except ValueError as error:
        raise malformed(f"a URDF {element.tag[:20]} whose {name} is not {count} numbers") from error


def _origin(element: Element) -> Float64Array:
    pose, origin = np.eye(4), element.find("origin")
    if origin is not None:
        turn = _numbers(origin, "rpy", 3, "0 0 0")
        from scipy.spatial.transform import Rotation  # what reads other meshes does without it

        pose[:3, :3] = Rotation.from_euler("xyz", turn).as_matrix()  # about the fixed axes
        pose[:3, 3] = _numbers(origin, "xyz", 3, "0 0 0")
    return pose


def _part(shape: Element, pose: Float64Array, siblings: Siblings, meshes: dict[str, Geometry], read: Read) -> Part:
    given = next(iter(_child(shape, "geometry")), shape)
    place = (pose @ _origin(shape))[None]
    if given.tag == "mesh":
        name = given.get("filename", "")
        mesh = meshes[name] = meshes.get(name) or _mesh(name, siblings, read)
        place = place @ np.diag([*_numbers(given, "scale", 3, "1 1 1"), 1.0])
        return Part(mesh.vertices, mesh.faces, place, mesh.colors)
    if given.tag not in _SIZES:
        raise malformed(f"a URDF geometry {given.tag[:20]} that does not exist")
    sizes = np.concatenate([_numbers(given, name, count) for name, count in _SIZES[given.tag]])
    return Part(*solid(given.tag, *sizes.tolist()), place)


def _mesh(name: str, siblings: Siblings, read: Read) -> Geometry:
    if name not in siblings:
        raise elsewhere(f"the URDF robot's mesh {name[-200:]} is not there: give both in one archive")
    data, ending = siblings[name], name.rpartition(".")[2].lower()
    head = bytes(data[:HEAD_BYTES])
    format_ = sniff_format(head) or (ending if ending in MESH_FORMATS else None)
    if format_ not in MESH_FORMATS or format_ == "urdf":
        raise unsupported(f"the URDF robot's mesh {name[-200:]}: {explain_refusal(head)[1]}")
    return read(format_, data)
