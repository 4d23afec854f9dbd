"""3MF models: the objects that are built, with their components, in meters. Only the core namespace has triangles."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from regnf_core.importing.assumptions import SCENE
from regnf_core.importing.containers.zip_members import DEFLATED, STORED, Member, read_members, require_modest
from regnf_core.importing.meshes.scene import INSTEAD, Nodes, Part, PlainXml, assembled, in_meters, parsed
from regnf_core.importing.meshes.triangle_files import (
    MAX_TRIANGLES,
    MAX_VERTICES,
    Float64Array,
    Geometry,
    Siblings,
    malformed,
    require_room,
    unsupported,
)

_CORE = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
_PATH = "{http://schemas.microsoft.com/3dmanufacturing/production/2015/06}path"
_UNITS = {
    "micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0,
}  # fmt: skip
_MAIN = "3D/3dmodel.model"
_MOST_BYTES, _MOST_LEVELS = 2 << 30, 32
_SUPPORTS = ("support", "solidsupport")
_OTHER_SHAPES = frozenset({"beamlattice", "booleanshape", "displacementmesh", "levelset"})
_Use = tuple[str, str, Float64Array]
"""Of an object: the part of the package that has it, its id, and its place (4, 4)."""


@dataclass(eq=False)
class _Object:
    """An object of a model: its triangles, as flat numbers, or its components."""

    name: str
    vertices: array[float] = field(default_factory=lambda: array("d"))
    corners: array[int] = field(default_factory=lambda: array("q"))
    components: list[_Use] = field(default_factory=list)


class _Model(PlainXml):
    """One part of the package, as it is parsed. path: its own."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self.unit, self.items = "millimeter", list[_Use]()
        self.objects: dict[str, _Object] = {}
        self.other: set[str] = set()
        self._path, self._now, self._supports = path, _Object(""), set[str]()

    def start(self, tag: str, attributes: dict[str, str]) -> None:  # type: ignore[override]
        """Takes what an element says: all is in attributes."""
        name = tag.removeprefix(_CORE)
        try:
            if name == "vertex":
                self._now.vertices.extend((float(attributes["x"]), float(attributes["y"]), float(attributes["z"])))
            elif name == "triangle":
                self._now.corners.extend((int(attributes["v1"]), int(attributes["v2"]), int(attributes["v3"])))
                if len(self._now.corners) > 3 * MAX_TRIANGLES or len(self._now.vertices) > 3 * MAX_VERTICES:
                    require_room(len(self._now.vertices) // 3, len(self._now.corners) // 3)
            elif name == "object":
                number = attributes["id"]
                self._now = self.objects[number] = _Object(attributes.get("name", ""))
                if attributes.get("type") in _SUPPORTS:
                    self._supports.add(number)
            elif name == "component":
                self._now.components.append(self._use(attributes))
            elif name == "item" and attributes["objectid"] not in self._supports:
                self.items.append(self._use(attributes))
            elif name == "model":
                self.unit = attributes.get("unit", self.unit)
            elif (local := tag.rpartition("}")[2]) in _OTHER_SHAPES:
                self.other.add(local)
        except (KeyError, ValueError, OverflowError) as error:
            raise malformed(f"a 3MF {name[:20]} without its numbers") from error

    def end(self, tag: str) -> None:  # type: ignore[override]
        """Nothing is kept, and text has no meaning here."""

    data = end

    def close(self) -> _Model:  # type: ignore[override]
        return self

    def _use(self, attributes: dict[str, str]) -> _Use:
        matrix = np.eye(4)
        if "transform" in attributes:
            matrix[:3] = np.array(attributes["transform"].split(), np.float64).reshape(4, 3).T
        return attributes.get(_PATH, self._path).lstrip("/"), attributes["objectid"], matrix


def read_3mf(data: memoryview, _: Siblings | None = None, node: str | None = None) -> Geometry:
    """The triangles of what a 3MF package builds. node: the name of the object to read.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, FORMAT_NOT_SUPPORTED for a package of something else,
    INVALID_DESCRIPTION, and the ARCHIVE_* reasons.
    """
    package = _Package(data)
    main, nodes = package.model(_MAIN), Nodes()
    placed = list(package.placed(main, nodes))
    read, notes = nodes.chosen(node)
    if main.unit not in _UNITS:
        raise malformed("the 3MF model has an unknown unit")
    scale = np.diag([*3 * [_UNITS[main.unit]], 1.0])
    parts = (_part(thing, scale @ place) for number, thing, place in placed if read[number])
    other = tuple(sorted(package.other))
    return assembled(parts, assumes=(SCENE,), notes=(*notes, in_meters(main.unit)), not_applied=other)


def _part(thing: _Object, place: Float64Array) -> Part:
    vertices, corners = np.frombuffer(thing.vertices, np.float64), np.frombuffer(thing.corners, np.int64)
    return Part(vertices.reshape(-1, 3), corners.reshape(-1, 3), place[None])


class _Package:
    """The models in a package by their paths, each parsed once."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        members = read_members(data, (STORED, DEFLATED), folders=True)
        self._members: dict[str, Member] = {member.name.lower(): member for member in members}
        self._models: dict[str, _Model] = {}
        self._left = _MOST_BYTES
        self.other: set[str] = set()
        """Shapes that are not read."""

    def model(self, path: str) -> _Model:
        """Raises FieldFormatError."""
        if path not in self._models:
            member = self._members.get(path.lower())
            if member is None:
                raise unsupported(f"an office document, or a 3MF package without {path[:60]}; {INSTEAD}")
            require_modest(member.size, member.packed_size, self._left)
            self._left -= member.size
            self._models[path] = parsed(member.content(self._data), _Model(path))
            self.other |= self._models[path].other
        return self._models[path]

    def placed(self, main: _Model, nodes: Nodes) -> Iterator[tuple[int, _Object, Float64Array]]:
        """The objects that are built and their components: the node, the object and its place."""
        waiting = [(use, -1, 0, np.eye(4)) for use in reversed(main.items)]
        while waiting:
            (path, number, local), above, level, outer = waiting.pop()
            thing = self.model(path).objects.get(number)
            if thing is None or level > _MOST_LEVELS:
                raise malformed("a 3MF component of no object, or of itself")
            place = outer @ local
            own = nodes.add(thing.name, above, int(len(thing.corners) > 0))
            if thing.corners:
                yield own, thing, place
            waiting.extend((use, own, level + 1, place) for use in reversed(thing.components))
