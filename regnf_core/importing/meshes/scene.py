"""Scenes of several nodes: which of them are read, what they are called, and their triangles in one frame."""

from __future__ import annotations

import importlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.meshes.triangle_files import Float64Array, Geometry, Int64Array, malformed, require_room

MAX_NODES = 100_000
_SHOWN, _SHOWN_LENGTH, _SHOWN_LEVELS = 20, 60, 64
"""How many names of nodes are shown, of how many characters, and of how many nodes above it a path is made."""
_GRAY = 0.8
"""Of parts without any color, beside others that have one."""
_PIECE = 1 << 20
_SECTIONS, _ROUND = 96, 4
"""How finely basic shapes are drawn: sections around an axis, and divisions of an icosahedron."""
INSTEAD = "export it as .glb, .ply, .obj or .stl"


class Nodes:
    """The nodes of a scene, each after the one above it. They are numbered as they are added."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._above: list[int] = []
        self._named_above: list[int] = []
        self._shapes: list[int] = []

    def add(self, name: object, above: int = -1, shapes: int = 0) -> int:
        """The number of a new node. above: of the node that it is part of, -1: none · shapes: how many are its own."""
        if len(self._names) >= MAX_NODES:
            raise malformed(f"a scene of more than {MAX_NODES} nodes")
        self._named_above.append(above if above < 0 or self._names[above] else self._named_above[above])
        self._names.append(name if isinstance(name, str) else "")
        self._above.append(above)
        self._shapes.append(shapes)
        return len(self._names) - 1

    def chosen(self, asked: str | None) -> tuple[Sequence[bool], tuple[str, ...]]:
        """Whether each node is read, and what is told of it. asked: a node's name, or names of a path to it, with ``/``
        between; it is read with all that is part of it. None: every node.

        Raises FieldFormatError (INVALID_DESCRIPTION) unless one node has the name, or those that have it one path: then
        the first is read.
        """
        below = list(self._shapes)
        for number in range(len(below) - 1, -1, -1):
            if self._above[number] >= 0:
                below[self._above[number]] += below[number]
        named = [number for number, count in enumerate(below) if count and self._names[number]]
        if asked is None:
            total = sum(self._shapes)
            parts = {self._names[number] for number in named if below[number] < total}
            told = f"its nodes, to choose one by the import option node: {_shown(parts)}"
            return [True] * len(below), (told,) * (len(parts) > 1)
        words = asked.strip("/").split("/")
        found = [number for number in named if self._names[number] == asked]
        found = found or [number for number in named if self._ends(number, words)]
        if not found:
            names = _shown({self._names[number] for number in named})
            _refuse(f"no node with a shape is named {asked[:_SHOWN_LENGTH]!r}; the file has {names}")
        if len(paths := {self._path(number) for number in found}) > 1:
            _refuse(f"several nodes are named {asked[:_SHOWN_LENGTH]!r}: give more of its path, of {_shown(paths)}")
        read = [False] * len(below)
        for number in range(found[0], len(below)):
            read[number] = number == found[0] or (self._above[number] >= 0 and read[self._above[number]])
        again = f", the first of {len(found)} with this path" if len(found) > 1 else ""
        return read, (f"only the node {self._path(found[0])}{again}",)

    def _ends(self, number: int, words: list[str]) -> bool:
        """Whether the names down to a node end in ``words``."""
        for word in reversed(words):
            if number < 0 or self._names[number] != word:
                return False
            number = self._named_above[number]
        return True

    def _path(self, number: int) -> str:
        names: list[str] = []
        while number >= 0 and len(names) < _SHOWN_LEVELS:
            names.append(self._names[number][:_SHOWN_LENGTH])
            number = self._named_above[number]
        return "/".join(reversed(names))


def _shown(names: set[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(name[-2 * _SHOWN_LENGTH :] for name in sorted(names)[:_SHOWN]) + more or "none"


def _refuse(message: str) -> NoReturn:
    raise FieldFormatError(f"description.node: {message}", reason="INVALID_DESCRIPTION")


def refuse_node(asked: str | None, format_: str) -> None:
    """Raise FieldFormatError (INVALID_DESCRIPTION) if a node of a file is asked for whose format has none."""
    if asked is not None:
        _refuse(f"a {format_} file has no nodes")


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles, and where they are. vertices: (V, 3) · faces: (F, 3) · matrices: (I, 4, 4), from their frame to the
    scene's, one for each instance · colors: (V, 3) in [0, 1], if there are any."""

    vertices: Float64Array
    faces: Int64Array
    matrices: Float64Array = field(default_factory=lambda: np.eye(4)[None])
    colors: Float64Array | None = None


def assembled(parts: Iterable[Part], **said: Any) -> Geometry:
    """The parts in the scene's frame. said: the other entries of the geometry. Raises FieldFormatError (MESH_INVALID,
    MESH_TOO_LARGE), before too much is made."""
    vertices: list[Float64Array] = []
    faces: list[Int64Array] = []
    colors: list[Float64Array | None] = []
    so_far = triangles = 0
    for part in parts:
        corners, count = part.faces, len(part.matrices)
        if len(corners) and (corners.min() < 0 or corners.max() >= len(part.vertices)):
            raise malformed("a face refers to a vertex that does not exist")
        require_room(so_far + count * len(part.vertices), triangles + count * len(corners))
        for matrix in part.matrices:
            turned = np.linalg.det(matrix[:3, :3]) < 0  # a mirrored node turns its faces round
            vertices.append(part.vertices @ matrix[:3, :3].T + matrix[:3, 3])
            faces.append((corners[:, ::-1] if turned else corners) + so_far)
            colors.append(part.colors)
            so_far, triangles = so_far + len(part.vertices), triangles + len(corners)
    shown = None
    if any(color is not None for color in colors):
        pairs = zip(colors, vertices, strict=True)
        shown = np.concatenate([np.full((len(own), 3), _GRAY) if color is None else color for color, own in pairs])
    empty = np.zeros((0, 3))
    return Geometry(
        np.concatenate([empty, *vertices]), np.concatenate([empty.astype(np.int64), *faces]), colors=shown, **said
    )


def solid(kind: str, *sizes: float) -> tuple[Float64Array, Int64Array]:
    """Vertices and faces of a shape around the origin: a box of three lengths, a sphere of a radius, or a cylinder,
    capsule or cone along z, of a radius and a height. Raises FieldFormatError (MESH_INVALID)."""
    from trimesh import creation  # half a second

    made: dict[str, Callable[..., Any]] = {
        "box": lambda *lengths: creation.box(lengths),
        "sphere": lambda radius: creation.icosphere(subdivisions=_ROUND, radius=radius),
        "cylinder": lambda radius, height: creation.cylinder(radius, height, sections=_SECTIONS),
        "capsule": lambda radius, height: creation.capsule(height, radius),
        "cone": lambda radius, height: creation.cone(radius, height, sections=_SECTIONS),
    }
    if not all(0.0 < size < np.inf for size in sizes):
        raise malformed(f"a {kind} whose size is not above 0")
    found = made[kind](*sizes)
    shift = (0.0, 0.0, -0.5 * sizes[1] if kind == "cone" else 0.0)
    return np.asarray(found.vertices, np.float64) + shift, np.asarray(found.faces, np.int64)


def in_meters(unit: str) -> str:
    """What is told of a file that states its unit."""
    return f"the file states {unit}" + ("" if unit == "meter" else ": coordinates were converted to meters")


def required(module: str, what: str) -> Any:
    """The module of an optional library. Raises FieldFormatError (FORMAT_NOT_SUPPORTED), which names its extra."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise FieldFormatError(
            f"{what} needs a library that is not installed",
            reason="FORMAT_NOT_SUPPORTED",
            hint=f"pip install 'regnf[cad]', or {INSTEAD}.",
        ) from error


class PlainXml(ElementTree.TreeBuilder):
    """A target for ``parsed`` that takes no document type, and with it no entities; by default it builds the tree."""

    def doctype(self, *_: object) -> NoReturn:
        raise malformed("an XML document with a DOCTYPE or entities")


def parsed(data: memoryview, target: ElementTree.TreeBuilder) -> Any:
    """What the target makes of an XML document. Raises FieldFormatError (MESH_INVALID)."""
    parser = ElementTree.XMLParser(target=target)  # noqa: S314 - the target refuses entities
    try:
        for start in range(0, len(data), _PIECE):
            parser.feed(bytes(data[start : start + _PIECE]))
        return parser.close()
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise malformed(f"the XML document is malformed: {error}") from error
