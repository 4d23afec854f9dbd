"""PLY (Stanford), text and binary of either byte order: vertices, their normals, polygons."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.meshes.thinning import Thinning, lines_of, numbers_of, rows_of_text
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

_MAX_HEADER = 1 << 20
_MAX_PARTS = 256
_CODES = {"i1": "char int8", "u1": "uchar uint8", "i2": "short int16", "u2": "ushort uint16"}
_CODES |= {"i4": "int int32", "u4": "uint uint32", "f4": "float float32", "f8": "double float64"}
_CODES |= {"i8": "int64", "u8": "uint64"}
_TYPES = {name: code for code, names in _CODES.items() for name in names.split()}
_FORMATS: dict[str, ByteOrder | None] = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"(?:^|[\r\n])end_header[ \t]*(?:\r?\n|\r)")
_ELEMENTS = {"vertices": "vertex", "point": "vertex", "points": "vertex", "faces": "face"}
"""Other names of elements, and what they are taken for."""


@dataclass(frozen=True)
class _Property:
    """One value of a row, or a list of them: numpy type codes without byte order."""

    name: str
    type: str
    count_type: str | None = None
    """The type of the length that stands before a list; None: a single value."""


@dataclass(frozen=True)
class _Element:
    """``count`` rows of the same properties."""

    name: str
    count: int
    properties: tuple[_Property, ...]

    def cut_short(self) -> FieldFormatError:
        return malformed(f"the PLY file ends within its {self.name[:40]} rows")


def _read_header(data: memoryview) -> tuple[ByteOrder | None, tuple[_Element, ...], int]:
    """The byte order, None for text; the elements; the header's bytes. Raises FieldFormatError (MESH_INVALID)."""
    head = bytes(data[:_MAX_HEADER])
    end = _END.search(head)
    if end is None:
        raise malformed("the PLY header has no end")
    lines = head[: end.start()].decode("latin-1").splitlines()
    words = [line.split() for line in lines[1:] if line.strip()]
    words = [line for line in words if line[0] not in ("comment", "obj_info")]
    if not words or words[0][0] != "format" or len(words[0]) < 2 or words[0][1] not in _FORMATS:
        raise malformed("the PLY header has an unknown format")
    return _FORMATS[words[0][1]], _elements(words[1:]), end.end()


def _elements(lines: list[list[str]]) -> tuple[_Element, ...]:
    found: list[tuple[str, int, list[_Property]]] = []
    for line in lines:
        match line:
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                found.append((_ELEMENTS.get(name, name), int(count), []))
            case ["property", "list", count_type, type_, name] if found and {count_type, type_} <= _TYPES.keys():
                found[-1][2].append(_Property(name.lower(), _TYPES[type_], _TYPES[count_type]))
            case ["property", type_, name] if found and type_ in _TYPES:
                found[-1][2].append(_Property(name.lower(), _TYPES[type_]))
            case _:
                raise malformed("the PLY header has an invalid line")
    elements = tuple(_Element(name, count, tuple(properties)) for name, count, properties in found)
    if len(elements) > _MAX_PARTS or len({element.name for element in elements}) != len(elements):
        raise malformed("the PLY header has an element twice, or too many elements")
    for element in elements:
        properties = [p.name for p in element.properties]
        if not properties or len(properties) > _MAX_PARTS or len(set(properties)) != len(properties):
            raise malformed(f"the PLY element {element.name[:40]} has no properties, too many, or one twice")
        if any((p.count_type or "").startswith("f") for p in element.properties):
            raise malformed("a PLY list whose length is not an integer")
    return elements


_USUAL_CORNERS = (3, 4)


class _Body:
    """The rows behind the header: hands out one element after the other. Text is read as numbers of float64 each."""

    flat_faces: int = 0
    """Faces of fewer than three corners, which were left out."""

    def __init__(self, data: memoryview, order: ByteOrder | None) -> None:
        self._data = numbers_of(bytes(data), "PLY").data.cast("B") if order is None else data
        self._order = order

    @property
    def left(self) -> int:
        """Bytes, or numbers of a text, behind what was handed out."""
        return len(self._data) // (8 if self._order is None else 1)

    def _type(self, code: str) -> np.dtype[Any]:
        return np.dtype(np.float64 if self._order is None else self._order + code)

    def table(self, element: _Element, corners: int = 0) -> Any | None:
        """(count,) rows by name if every list has ``corners`` items; None, nothing taken, if not."""
        fields: list[tuple[Any, ...]] = []
        for p in element.properties:
            if p.count_type is not None:
                fields.append((f"{p.name} length", self._type(p.count_type)))
            fields.append((p.name, self._type(p.type), () if p.count_type is None else (corners,)))
        row = np.dtype(fields)
        if element.count * row.itemsize > len(self._data):
            return None
        rows = np.frombuffer(self._data, row, element.count) if element.count else np.zeros(0, row)
        lengths = [name for name in row.names or () if name.endswith(" length")]
        if not all((rows[name] == corners).all() for name in lengths):
            return None
        self._data = self._data[rows.nbytes :]
        return rows

    def rows(self, element: _Element) -> Iterator[dict[str, Any]]:
        """The rows one by one; lists as arrays."""
        data, at = self._data, 0
        types = [
            (p.name, self._type(p.type), None if p.count_type is None else self._type(p.count_type))
            for p in element.properties
        ]
        for _ in range(element.count):
            row: dict[str, Any] = {}
            for name, type_, count_type in types:
                count = 1.0
                if count_type is not None:
                    if at + count_type.itemsize > len(data):
                        raise element.cut_short()
                    count = np.frombuffer(data, count_type, 1, at)[0]
                    at += count_type.itemsize
                if not 0 <= count <= (len(data) - at) // type_.itemsize:
                    raise element.cut_short()
                size = int(count) * type_.itemsize
                row[name] = np.frombuffer(data[at : at + size], dtype=type_)
                at += size
            yield row
        self._data = data[at:]

    def scalars(self, element: _Element) -> dict[str, Float64Array]:
        """The columns (count,) of an element's single values; lists beside them are passed over."""
        names = [p.name for p in element.properties if p.count_type is None]
        if len(names) == len(element.properties):
            rows = self.table(element)
            if rows is None:
                raise element.cut_short()
            return {name: rows[name].astype(np.float64) for name in names}
        table = [[float(row[name][0]) for name in names] for row in self.rows(element)]
        columns = np.array(table, dtype=np.float64).reshape(element.count, len(names)).T
        return dict(zip(names, columns, strict=True))

    def triangles(self, element: _Element, name: str) -> Int64Array:
        """(F, 3) indices from the lists called ``name``, longer ones as fans."""
        for corners in _USUAL_CORNERS:
            rows = self.table(element, corners)
            if rows is not None:
                require_room(0, (corners - 2) * element.count)
                return fans(_whole(rows[name]))
        found: list[Int64Array] = [np.zeros((0, 3), np.int64)]
        triangles = 0
        for row in self.rows(element):
            polygon = _whole(row[name])
            self.flat_faces += len(polygon) < 3
            triangles += max(len(polygon) - 2, 0)
            require_room(0, triangles)
            found.append(fan(polygon))
        return np.concatenate(found)


class PlyTables:
    """A PLY file whose rows all have one length: no element has a list."""

    def __init__(self, data: memoryview) -> None:
        """Raises FieldFormatError (MESH_INVALID)."""
        order, self._elements, size = _read_header(data)
        self._body = _Body(data[size:], order)

    def count(self, name: str) -> int:
        """How many rows of an element the header claims; 0 where it has none."""
        return next((element.count for element in self._elements if element.name == name), 0)

    def rows(self) -> dict[str, npt.NDArray[Any]]:
        """(count,) of each element, by name. Raises FieldFormatError (MESH_INVALID)."""
        found = {}
        for element in self._elements:
            if any(p.count_type is not None for p in element.properties):
                raise malformed(f"the PLY element {element.name[:40]} has a list")
            rows = self._body.table(element)
            if rows is None:
                raise element.cut_short()
            found[element.name] = rows
        return found


def _whole(values: npt.NDArray[Any]) -> Int64Array:
    """Numbers as indices. Raises FieldFormatError (MESH_INVALID) for what is none."""
    if values.dtype.kind == "f" and not (np.isfinite(values) & (np.abs(values) < 2.0**53)).all():
        raise malformed("a PLY index that is not a number")
    return values.astype(np.int64)


_INDEX_NAMES = ("vertex_indices", "vertex_index")
_COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_MAX_ROWS = 50_000_000
_PLACES, _NORMALS = ("x", "y", "z"), (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))


def read_ply(data: memoryview) -> Geometry:
    """The vertices and polygons (as fans) or strips of a PLY file; without faces it is a point cloud.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE.
    """
    order, elements, size = _read_header(data)
    if order is None and elements:
        _require_rows(data[size:], elements)
    if _is_large_cloud(elements):
        return _thinned(data[size:], order, elements)
    body = _Body(data[size:], order)
    vertices, normals, colors = np.zeros((0, 3)), None, None
    faces = np.zeros((0, 3), np.int64)
    left_out: list[str] = []
    for element in elements:
        if element.name == "vertex":
            require_room(element.count, 0)
            table = body.scalars(element)
            vertices = _columns(table, _PLACES)
            normals = next((_columns(table, names) for names in _NORMALS if set(names) <= table.keys()), None)
            colors = _colors(table, element)
        elif element.name == "face":
            require_room(0, element.count)
            faces = np.concatenate([faces, body.triangles(element, _index_property(element))])
        elif element.name == "tristrips":
            require_room(0, element.count)
            name = _index_property(element)
            faces = np.concatenate([faces, *(_strip(_whole(row[name])) for row in body.rows(element))])
        elif element.count > _MAX_ROWS:
            raise malformed(f"the PLY file claims {element.count} rows of {element.name[:40]}")
        else:
            body.scalars(element)
            left_out.append(f"elements {element.name[:40]}")
    if body.flat_faces and len(faces) == 0:
        raise malformed("no face of the PLY file has three corners")
    if body.left:
        left_out.append(f"{body.left} bytes or numbers after its rows")
    if body.flat_faces:
        left_out.append(f"{body.flat_faces} faces of fewer than three corners")
    return Geometry(vertices, faces, normals, colors, tuple(left_out))


def _require_rows(body: memoryview, elements: tuple[_Element, ...]) -> None:
    """Raise FieldFormatError (MESH_INVALID) for lines of a text with more or fewer numbers than the header says."""
    first = elements[0]
    if first.count == 0 or any(p.count_type is not None for p in first.properties):
        return
    numbers = len(next((line for line in bytes(body[:_MAX_HEADER]).splitlines() if line.strip()), b"").split())
    if numbers != len(first.properties) and lines_of(body) >= first.count:  # a row may also take several lines
        said = f"the PLY header says {len(first.properties)} numbers for each {first.name[:40]}"
        raise malformed(f"{said}, but its first line has {numbers}")


def _is_large_cloud(elements: tuple[_Element, ...]) -> bool:
    """Whether the file holds points alone, more than are kept, in rows of one length at its beginning."""
    faces = sum(element.count for element in elements if element.name in ("face", "tristrips"))
    first = elements[0] if elements else _Element("", 0, ())
    plain = all(p.count_type is None for p in first.properties)
    return faces == 0 and first.name == "vertex" and Thinning(first.count).step > 1 and plain


def _thinned(body: memoryview, order: ByteOrder | None, elements: tuple[_Element, ...]) -> Geometry:
    """The points that are kept of many."""
    element = elements[0]
    names = [p.name for p in element.properties]
    wanted = [*_PLACES, *next((each for each in _NORMALS if set(each) <= set(names)), ())]
    if not set(wanted) <= set(names):
        raise malformed("PLY vertices without x, y, z")
    thinning = Thinning(element.count)
    if order is None:
        rows, read = rows_of_text(body, len(names), thinning, "PLY")
        if read < element.count:
            raise element.cut_short()
        found = rows[:, [names.index(name) for name in wanted]]
    else:
        row = np.dtype([(p.name, order + p.type) for p in element.properties])
        if element.count * row.itemsize > len(body):
            raise element.cut_short()
        table, kept = np.frombuffer(body, row, element.count), thinning.kept(0, element.count)
        found = np.stack([table[name][kept].astype(np.float64) for name in wanted], axis=1)
    left_out = (*thinning.left_out, *(f"elements {one.name[:40]}" for one in elements[1:]))
    return Geometry(
        found[:, :3], np.zeros((0, 3), np.int64), found[:, 3:] if len(wanted) > 3 else None, left_out=left_out
    )


def _colors(table: dict[str, Float64Array], element: _Element) -> Float64Array | None:
    """Of the vertices, in [0, 1]: whole numbers are shares of the largest of their type."""
    types = {p.name: p.type for p in element.properties}
    for names in _COLOR_NAMES:
        kinds = {types.get(name) for name in names}
        if len(kinds) == 1 and None not in kinds:
            kind = np.dtype(kinds.pop())
            return within_unit(_columns(table, names), 1.0 if kind.kind == "f" else float(np.iinfo(kind).max))
    return None


def _strip(order: Int64Array) -> Int64Array:
    require_room(0, len(order))
    return strips(order)


def _columns(table: dict[str, Float64Array], names: tuple[str, ...]) -> Float64Array:
    if not table.keys() >= set(names):
        raise malformed(f"PLY vertices without {', '.join(names)}")
    return np.stack([table[name] for name in names], axis=1)


def _index_property(element: _Element) -> str:
    lists = [p.name for p in element.properties if p.count_type is not None]
    found = [name for name in lists if name in _INDEX_NAMES] or lists  # a single list of faces is their corners
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
