"""PLY (Stanford), text and binary of either byte order: vertices, their normals, polygons."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.meshes.point_files import numbers_of
from regnf_core.importing.meshes.triangle_files import (
    Float64Array,
    Geometry,
    Int64Array,
    fan,
    fans,
    malformed,
    require_room,
    strips,
    within_unit,
)

# The header of a PLY file: which elements follow, and what each row of them holds.

ByteOrder = Literal["<", ">"]

_MAX_HEADER = 1 << 16
_MAX_PARTS = 64
_CODES = {"i1": "char int8", "u1": "uchar uint8", "i2": "short int16", "u2": "ushort uint16"} | {
    "i4": "int int32",
    "u4": "uint uint32",
    "f4": "float float32",
    "f8": "double float64",
}
_TYPES = {name: code for code, names in _CODES.items() for name in names.split()}
_FORMATS: dict[str, ByteOrder | None] = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"(?:^|\n)end_header[ \t]*\r?\n")

_SPLAT = frozenset({"f_dc_0", "opacity", "scale_0", "rot_0"})
"""Of the points that are Gaussians."""


@dataclass(frozen=True)
class Property:
    """One value of a row, or a list of them: numpy type codes without byte order."""

    name: str
    type: str
    count_type: str | None = None
    """The type of the length that stands before a list; None: a single value."""


@dataclass(frozen=True)
class Element:
    """``count`` rows of the same properties."""

    name: str
    count: int
    properties: tuple[Property, ...]


@dataclass(frozen=True)
class Header:
    """The header takes ``size`` bytes; ``byte_order`` None means text."""

    byte_order: ByteOrder | None
    elements: tuple[Element, ...]
    size: int


def read_ply_header(data: memoryview) -> Header:
    """The header. Raises FieldFormatError: MESH_INVALID, or FAMILY_NOT_SUPPORTED for Gaussian splats."""
    head = bytes(data[:_MAX_HEADER])
    end = _END.search(head)
    if end is None:
        raise malformed("no end of the PLY header in sight")
    lines = head[: end.start()].decode("latin-1").splitlines()
    words = [line.split() for line in lines[1:] if line.strip()]
    words = [line for line in words if line[0] not in ("comment", "obj_info")]
    if not words or words[0][0] != "format" or len(words[0]) != 3 or words[0][1] not in _FORMATS:
        raise malformed("the PLY header names no known format")
    return Header(_FORMATS[words[0][1]], _elements(words[1:]), end.end())


def _elements(lines: list[list[str]]) -> tuple[Element, ...]:
    found: list[tuple[str, int, list[Property]]] = []
    for line in lines:
        match line:
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                found.append((name, int(count), []))
            case ["property", "list", count_type, type_, name] if found and {count_type, type_} <= _TYPES.keys():
                found[-1][2].append(Property(name, _TYPES[type_], _TYPES[count_type]))
            case ["property", type_, name] if found and type_ in _TYPES:
                found[-1][2].append(Property(name, _TYPES[type_]))
            case _:
                raise malformed("the PLY header has a line that makes no sense")
    elements = tuple(Element(name, count, tuple(properties)) for name, count, properties in found)
    names = [element.name for element in elements]
    if len(elements) > _MAX_PARTS or len(set(names)) != len(names):
        raise malformed("the PLY header names an element twice, or too many of them")
    for element in elements:
        properties = [p.name for p in element.properties]
        if set(properties) >= _SPLAT:
            message = "Gaussian splats, which have no surface; extract a mesh from them, and give that"
            raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
        if not properties or len(properties) > _MAX_PARTS or len(set(properties)) != len(properties):
            raise malformed(f"the PLY element {element.name[:40]} has no properties, too many, or one twice")
        if any(p.count_type is not None and p.count_type.startswith("f") for p in element.properties):
            raise malformed("a PLY list whose length is not an integer")
    return elements


# The rows of a PLY file, as text or in binary: single values at once, rows with lists one by one if they must be.

_USUAL_CORNERS = (3, 4)


class Body(ABC):
    """Hands out one element after the other, in the header's order."""

    flat_faces: int = 0
    """Faces of fewer than three corners, which were left out."""

    @abstractmethod
    def scalars(self, element: Element) -> dict[str, Float64Array]:
        """The columns (count,) of an element's single values; lists beside them are passed over."""

    @abstractmethod
    def _regular(self, element: Element, corners: int) -> Any | None:
        """(count, columns) rows by name if every list has this length; None, nothing taken, if not."""

    @abstractmethod
    def _rows(self, element: Element) -> Iterator[dict[str, Any]]:
        """The rows one by one; lists as arrays."""

    def _scalars_beside_lists(self, element: Element) -> dict[str, Float64Array]:
        names = [p.name for p in element.properties if p.count_type is None]
        table = [[float(row[name][0]) for name in names] for row in self._rows(element)]
        columns = np.array(table, dtype=np.float64).reshape(-1, len(names)).T
        return dict(zip(names, columns, strict=True))

    def skip(self, element: Element) -> None:
        """Pass over an element."""
        if all(p.count_type is None for p in element.properties):
            self.scalars(element)
        else:
            for _ in self._rows(element):
                pass

    def lists(self, element: Element, name: str) -> Iterator[Int64Array]:
        """The list called ``name`` of every row, of any length."""
        for row in self._rows(element):
            yield np.asarray(row[name], dtype=np.int64)

    def triangles(self, element: Element, name: str) -> Int64Array:
        """(F, 3) indices from the lists called ``name``, longer ones as fans."""
        for corners in _USUAL_CORNERS:
            rows = self._regular(element, corners)
            if rows is not None:
                require_room(0, (corners - 2) * element.count)
                return fans(rows[name])
        found: list[Int64Array] = []
        triangles = 0
        for row in self._rows(element):
            polygon = np.asarray(row[name], dtype=np.int64)
            self.flat_faces += len(polygon) < 3
            triangles += max(len(polygon) - 2, 0)
            require_room(0, triangles)
            found.append(fan(polygon))
        return np.concatenate(found) if found else np.zeros((0, 3), np.int64)


class BinaryBody(Body):
    """Rows of packed numbers."""

    def __init__(self, data: memoryview, byte_order: ByteOrder) -> None:
        self._data = data
        self._order = byte_order

    def scalars(self, element: Element) -> dict[str, Float64Array]:
        if any(p.count_type is not None for p in element.properties):
            return self._scalars_beside_lists(element)
        rows = self._table(element, 0)
        if rows is None:
            raise malformed(f"the PLY file ends within its {element.name[:40]} rows")
        self._data = self._data[rows.nbytes :]
        return {p.name: rows[p.name].astype(np.float64) for p in element.properties}

    def _regular(self, element: Element, corners: int) -> Any | None:
        lists = [p.name for p in element.properties if p.count_type is not None]
        rows = self._table(element, corners)
        if len(lists) != 1 or rows is None or not (rows[f"{lists[0]} length"] == corners).all():
            return None
        self._data = self._data[rows.nbytes :]
        return rows

    def _table(self, element: Element, corners: int) -> Any | None:
        """The rows if every list has ``corners`` items; None if there are not so many bytes."""
        fields: list[tuple[Any, ...]] = []
        for p in element.properties:
            if p.count_type is None:
                fields.append((p.name, self._order + p.type))
            else:
                fields.append((f"{p.name} length", self._order + p.count_type))
                fields.append((p.name, self._order + p.type, (corners,)))
        row = np.dtype(fields)
        if element.count * row.itemsize > len(self._data):
            return None
        return np.frombuffer(self._data, dtype=row, count=element.count)

    def _rows(self, element: Element) -> Iterator[dict[str, Any]]:
        data, at = self._data, 0
        types = [(p, np.dtype(self._order + p.type), p.count_type) for p in element.properties]
        for _ in range(element.count):
            row: dict[str, Any] = {}
            for p, type_, count_type in types:
                count = 1
                if count_type is not None:
                    width = np.dtype(count_type).itemsize
                    order, signed = ("little" if self._order == "<" else "big"), count_type.startswith("i")
                    count = int.from_bytes(data[at : at + width], order, signed=signed)  # type: ignore[arg-type]
                    at += width
                size = count * type_.itemsize
                if count < 0 or at + size > len(data):
                    raise malformed(f"the PLY file ends within its {element.name[:40]} rows")
                row[p.name] = np.frombuffer(data[at : at + size], dtype=type_)
                at += size
            yield row
        self._data = data[at:]


class TextBody(Body):
    """Rows of numbers between spaces."""

    def __init__(self, data: memoryview) -> None:
        self._numbers = numbers_of(bytes(data), "PLY")

    def scalars(self, element: Element) -> dict[str, Float64Array]:
        if any(p.count_type is not None for p in element.properties):
            return self._scalars_beside_lists(element)
        width = len(element.properties)
        rows = self._take(element, element.count * width).reshape(element.count, width)
        return {p.name: rows[:, i] for i, p in enumerate(element.properties)}

    def _regular(self, element: Element, corners: int) -> Any | None:
        if len(element.properties) != 1 or element.count * (corners + 1) > len(self._numbers):
            return None
        rows = self._numbers[: element.count * (corners + 1)].reshape(element.count, corners + 1)
        if not (rows[:, 0] == corners).all():
            return None
        self._take(element, rows.size)
        return {element.properties[0].name: _whole(rows[:, 1:])}

    def _rows(self, element: Element) -> Iterator[dict[str, Any]]:
        numbers, at = self._numbers, 0
        for _ in range(element.count):
            row: dict[str, Any] = {}
            for p in element.properties:
                count = 1
                if p.count_type is not None:
                    claimed = numbers[at] if at < len(numbers) else -1.0
                    count = int(claimed) if 0 <= claimed <= len(numbers) else -1
                    at += 1
                if count < 0 or at + count > len(numbers):
                    raise malformed(f"the PLY file ends within its {element.name[:40]} rows")
                values = numbers[at : at + count]
                row[p.name] = _whole(values) if p.count_type is not None else values
                at += count
            yield row
        self._numbers = numbers[at:]

    def _take(self, element: Element, count: int) -> Float64Array:
        if count > len(self._numbers):
            raise malformed(f"the PLY file ends within its {element.name[:40]} rows")
        taken, self._numbers = self._numbers[:count], self._numbers[count:]
        return taken


def _whole(values: Float64Array) -> Int64Array:
    """Numbers as indices. Raises FieldFormatError (MESH_INVALID) for what is none."""
    if not (np.isfinite(values) & (np.abs(values) < 2.0**53)).all():
        raise malformed("a PLY index that is not a number")
    return values.astype(np.int64)


_INDEX_NAMES = ("vertex_indices", "vertex_index")
_COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_MAX_ROWS = 50_000_000


def read_ply(data: memoryview) -> Geometry:
    """The vertices and polygons (as fans) or strips of a PLY file; without faces it is a point cloud.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE.
    """
    header = read_ply_header(data)
    rest = data[header.size :]
    body = TextBody(rest) if header.byte_order is None else BinaryBody(rest, header.byte_order)
    vertices, normals, colors = np.zeros((0, 3)), None, None
    faces = np.zeros((0, 3), np.int64)
    left_out: list[str] = []
    for element in header.elements:
        if element.name == "vertex":
            require_room(element.count, 0)
            table = body.scalars(element)
            vertices = _columns(table, ("x", "y", "z"))
            if {"nx", "ny", "nz"} <= table.keys():
                normals = _columns(table, ("nx", "ny", "nz"))
            colors = _colors(table, element)
        elif element.name == "face":
            require_room(0, element.count)
            faces = np.concatenate([faces, body.triangles(element, _index_property(element))])
        elif element.name == "tristrips":
            require_room(0, element.count)
            faces = np.concatenate([faces, *(_strip(order) for order in body.lists(element, _index_property(element)))])
        elif element.count > _MAX_ROWS:
            raise malformed(f"the PLY file claims {element.count} rows of {element.name[:40]}")
        else:
            body.skip(element)
            left_out.append(f"elements {element.name[:40]}")
    if body.flat_faces and len(faces) == 0:
        raise malformed("no face of the PLY file has three corners")
    if body.flat_faces:
        left_out.append(f"{body.flat_faces} faces of fewer than three corners")
    return Geometry(vertices, faces, normals, colors, tuple(left_out))


def _colors(table: dict[str, Float64Array], element: Element) -> Float64Array | None:
    """Of the vertices, in [0, 1]: whole numbers are shares of the largest of their type."""
    types = {p.name: p.type for p in element.properties}
    for names in _COLOR_NAMES:
        kinds = {types.get(name) for name in names}
        if len(kinds) == 1 and None not in kinds:
            kind = np.dtype(kinds.pop())
            return within_unit(_columns(table, names), 1.0 if kind.kind == "f" else float(np.iinfo(kind).max))
    return None


def _strip(order: npt.NDArray[Any]) -> Int64Array:
    require_room(0, len(order))
    return strips(order)


def _columns(table: dict[str, Float64Array], names: tuple[str, ...]) -> Float64Array:
    if not table.keys() >= set(names):
        raise malformed(f"PLY vertices without {', '.join(names)}")
    return np.stack([table[name] for name in names], axis=1)


def _index_property(element: Element) -> str:
    found = [p.name for p in element.properties if p.count_type is not None and p.name in _INDEX_NAMES]
    if len(found) != 1:
        raise malformed("PLY faces or strips without one list of vertex indices")
    return found[0]


def ply_bytes(geometry: Geometry) -> bytes:
    """A binary file of the geometry, places as they are in float64, that ``read_ply`` reads."""
    columns = [("x", geometry.vertices[:, 0], "<f8"), ("y", geometry.vertices[:, 1], "<f8")]
    columns.append(("z", geometry.vertices[:, 2], "<f8"))
    if geometry.normals is not None:
        columns += [(name, geometry.normals[:, axis], "<f8") for axis, name in enumerate(("nx", "ny", "nz"))]
    if geometry.colors is not None:
        levels = np.rint(255.0 * geometry.colors)
        columns += [(name, levels[:, axis], "u1") for axis, name in enumerate(_COLOR_NAMES[0])]
    rows = np.empty(len(geometry.vertices), [(name, kind) for name, _, kind in columns])
    for name, values, _ in columns:
        rows[name] = values
    faces = np.empty(len(geometry.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, geometry.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {'double' if kind == '<f8' else 'uchar'} {name}" for name, _, kind in columns]
    if len(faces):
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    return "\n".join([*header, "end_header", ""]).encode() + rows.tobytes() + faces.tobytes()
