"""What a mesh file holds that a field needs, and the limits that all readers share."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.assumptions import PLACES, Assumptions
from regnf_core.importing.containers.plain_text import number, unmarked
from regnf_core.importing.containers.sniff import STL_COUNT_OPEN, uncommented
from regnf_core.schema.description import Axis

Float64Array = npt.NDArray[np.float64]
Int64Array = npt.NDArray[np.int64]

Siblings = Mapping[str, memoryview]
"""The files that came with a mesh in one archive, by their names relative to it."""

MAX_TRIANGLES = 2_000_000
MAX_VERTICES = 6_000_000


@dataclass(frozen=True)
class Geometry:
    """Points, and the triangles between them; nothing of it is checked but its shapes."""

    vertices: Float64Array
    """(V, 3), the file's own frame and unit."""
    faces: Int64Array
    """(F, 3) indices; F is 0 for a point cloud."""
    normals: Float64Array | None = None
    """(V, 3), where the file has one a vertex."""
    colors: Float64Array | None = None
    """(V, 3) in [0, 1], R, G, B, where the file has one a vertex."""
    left_out: tuple[str, ...] = ()
    """What the file holds or names that was not read, a few words each: the shape is the same without."""
    not_applied: tuple[str, ...] = ()
    """The same of what changes the shape: it is warned of."""
    sensor: Float64Array | None = None
    """(3,) from where all points were measured, where the file says so; or (V, 3) from where each was, NaN: unknown."""
    up_axis: Axis | None = None
    """The axis that points up, where the file says so."""
    notes: tuple[str, ...] = ()
    """What is told about the file's unit and its nodes, one short sentence each."""
    assumes: Assumptions = PLACES
    """What the file does not say and was taken for granted."""


def not_numbers(message: str, text: bytes) -> FieldFormatError:
    """The error for words that are no numbers, which says so where the reason is how decimals are written."""
    commas = re.search(rb"\d,\d", text) is not None
    return malformed(message + (": write decimal points, not commas" if commas else ""))


def malformed(message: str) -> FieldFormatError:
    """The error for a file that breaks its own format."""
    return FieldFormatError(message, reason="MESH_INVALID")


def elsewhere(message: str) -> FieldFormatError:
    """The error for a file whose geometry lies in another file, or that would have a command run."""
    return FieldFormatError(message, reason="MESH_EXTERNAL_REFERENCE")


def unsupported(message: str) -> FieldFormatError:
    """The error for a sound file that uses a part of its format which is not read here."""
    return FieldFormatError(message, reason="FORMAT_NOT_SUPPORTED")


def require_room(vertices: int, triangles: int) -> None:
    """Raise FieldFormatError (MESH_TOO_LARGE) beyond the limits. Ask before arrays of these lengths are made."""
    if vertices > MAX_VERTICES:
        raise FieldFormatError(f"{vertices} vertices; at most {MAX_VERTICES} are allowed", reason="MESH_TOO_LARGE")
    if triangles > MAX_TRIANGLES:
        raise FieldFormatError(f"{triangles} triangles; at most {MAX_TRIANGLES} are allowed", reason="MESH_TOO_LARGE")


def within_unit(colors: Float64Array, top: float = 1.0) -> Float64Array:
    """Colors of numbers up to ``top`` as such in [0, 1]; what is not a number is black."""
    return np.nan_to_num(colors / top, nan=0.0, posinf=1.0, neginf=0.0).clip(0.0, 1.0)


def fans(polygons: npt.NDArray[Any]) -> Int64Array:
    """(F, 3) triangles from (P, n) polygons of n >= 3 corners each, as fans round their first corner."""
    corners = np.asarray(polygons, dtype=np.int64)
    parts = [corners[:, [0, i, i + 1]] for i in range(1, corners.shape[1] - 1)]
    triangles: Int64Array = np.concatenate(parts) if parts else np.zeros((0, 3), np.int64)
    return triangles


def strips(order: npt.NDArray[Any]) -> Int64Array:
    """(F, 3) triangles from corners (N,) in strips, which -1 parts; every second triangle of a strip is turned."""
    corners = np.asarray(order, dtype=np.int64)
    if len(corners) < 3:
        return np.zeros((0, 3), np.int64)
    place = np.arange(len(corners))
    begun = np.maximum.accumulate(np.where(corners == -1, place + 1, 0))
    triangles = np.stack((corners[:-2], corners[1:-1], corners[2:]), axis=1)
    turned = ((place - begun)[:-2] % 2 == 1)[:, None]
    triangles = np.where(turned, triangles[:, [1, 0, 2]], triangles)
    whole: Int64Array = triangles[(triangles != -1).all(axis=1)]
    return whole


def fan(order: npt.NDArray[Any]) -> Int64Array:
    """(N - 2, 3) triangles of corners (N,) around the first of them."""
    corners = np.asarray(order, dtype=np.int64)
    return fans(corners[None]) if len(corners) >= 3 else np.zeros((0, 3), np.int64)


def polygons(counts: npt.NDArray[Any], corners: npt.NDArray[Any]) -> Int64Array:
    """(F, 3) triangles of polygons: ``counts`` (P,) corners each, one after the other in ``corners``."""
    counts, corners = np.asarray(counts, np.int64), np.asarray(corners, np.int64)
    if counts.sum() != len(corners) or (counts < 0).any():
        raise malformed("polygons with more or fewer corners than their counts say")
    begun = np.cumsum(counts) - counts
    alike = [begun[counts == n][:, None] + np.arange(n) for n in np.unique(counts) if n >= 3]
    return np.concatenate([np.zeros((0, 3), np.int64), *(fans(corners[rows]) for rows in alike)])


# Wavefront OBJ: vertices and polygons. Everything else is ignored; no other file is opened.

_FACES = (b"f", b"fo")
_COMMANDS = (b"call", b"csh")
_NOTED = {b"mtllib": "materials in another file", b"curv": "curves", b"l": "lines", b"p": "points"}
_SURFACE = b"surf"
_NAMING = frozenset(b"g o s usemtl mtllib usemap maplib".split())
"""Statements that no backslash continues: it may be part of a name."""


def read_obj(data: memoryview) -> Geometry:
    """The polygons of an OBJ file, as fans of triangles. Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, or
    MESH_EXTERNAL_REFERENCE for one that would have a command run.
    """
    vertices: list[list[float]] = []
    colors: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    left_out: set[str] = set()
    flat = surfaces = 0
    for words in _statements(bytes(data)):
        if words[0] == b"v":
            vertices.append(_place(words))
            colors.extend(_color(words))
        elif words[0] in _FACES:
            corners = [_index(word, len(vertices)) for word in words[1:]]
            flat += len(corners) < 3
            triangles.extend((corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1))
            require_room(len(vertices), len(triangles))
        elif words[0] in _COMMANDS:
            raise elsewhere("the OBJ file refers to another file or to a command")
        elif words[0] == _SURFACE:
            surfaces += 1
        elif words[0] in _NOTED:
            left_out.add(_NOTED[words[0]])
    require_room(len(vertices), len(triangles))
    return Geometry(
        np.array(vertices, dtype=np.float64).reshape(-1, 3),
        np.array(triangles, dtype=np.int64).reshape(-1, 3),
        colors=_shares(np.array(colors)) if vertices and len(colors) == len(vertices) else None,
        left_out=(*sorted(left_out), *([f"{flat} faces of fewer than three corners"] if flat else [])),
        not_applied=(f"{surfaces} free-form surfaces",) if surfaces else (),
    )


def _statements(text: bytes) -> Iterator[list[bytes]]:
    """The words of each statement, without comments. One of numbers goes on behind a backslash."""
    begun: list[bytes] = []
    for line in text.splitlines():
        words = begun + line.partition(b"#")[0].split()
        begun = []
        if words and words[-1].endswith(b"\\") and words[0] not in _NAMING:
            begun = [*words[:-1], *filter(None, [words[-1][:-1]])]
        elif words:
            yield words
    if begun:
        yield begun


def _place(words: list[bytes]) -> list[float]:
    """NaN, which is left out, for a row that is none."""
    try:
        x, y, z = map(number, words[1:4])  # a fourth number is a weight, more are a color
    except ValueError as error:
        if b"," in b"".join(words):
            raise not_numbers("an OBJ vertex is not three numbers", b" ".join(words)) from error
        return [math.nan] * 3
    return [x, y, z]


def _shares(colors: Float64Array) -> Float64Array:
    """Colors in [0, 1]; no standard says what 1 is, and some write numbers up to 255."""
    return within_unit(colors, 255.0 if colors.max() > 1.0 else 1.0)


def _color(words: list[bytes]) -> list[list[float]]:
    """The three numbers behind a vertex's place, if there are so many and they are numbers."""
    try:
        return [list(map(float, words[-3:]))] if len(words) in (7, 8) else []
    except ValueError:
        return []


def _index(word: bytes, so_far: int) -> int:
    """A corner as v, v/vt, v//vn or v/vt/vn: counted from 1, or backwards from the latest vertex."""
    try:
        written = word.partition(b"/")[0]
        corner = int(written if b"." not in written else number(written))
    except ValueError as error:
        raise malformed("an OBJ face has a corner that is not a number") from error
    if corner == 0 or abs(corner) >= 1 << 62:
        raise malformed("an OBJ face has the corner 0, or one of no vertex: corners count from 1")
    return corner - 1 if corner > 0 else so_far + corner


# STL, binary and text: loose triangles.

_SOLID_NAMES = re.compile(rb"^[ \t]*(?:end)?solid[^\r\n]*", re.IGNORECASE | re.MULTILINE)
_COUNT_AT, _FACETS_AT, _FACET_BYTES = 80, 84, 50
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(data: memoryview) -> Geometry:
    """The triangles of an STL file. Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE."""
    count = int.from_bytes(data[_COUNT_AT:_FACETS_AT], "little")
    room, rest = divmod(max(len(data) - _FACETS_AT, 0), _FACET_BYTES)
    text = uncommented(unmarked(bytes(data)))
    is_text = text[:5].lower() == b"solid"
    if count in STL_COUNT_OPEN and not rest and not is_text:
        count = room
    behind = len(data) - (_FACETS_AT + _FACET_BYTES * count)
    if len(data) >= _FACETS_AT and (behind == 0 or (behind > 0 and not is_text)):
        require_room(3 * count, count)
        facets = np.frombuffer(data[_FACETS_AT:], dtype=_FACET, count=count)
        found = _loose(facets["corners"].reshape(-1, 3).astype(np.float64))
        if behind and behind % _FACET_BYTES == 0:
            return replace(found, not_applied=(f"{behind // _FACET_BYTES} facets beyond the {count} of its header",))
        return replace(found, left_out=(f"{behind} bytes after the triangles",)) if behind else found
    if not is_text:
        raise malformed(f"the STL file ends within its {count} facets: it has room for {room}")
    unnamed = _SOLID_NAMES.sub(b"", text)  # a name may say `vertex`
    return _loose(_corners_of_text(unnamed if b"vertex" in unnamed.lower() else text))


def _corners_of_text(text: bytes) -> Float64Array:
    words = text.split()
    at = [i for i, word in enumerate(words) if word.lower() == b"vertex"]
    require_room(len(at), len(at) // 3)
    if at and at[-1] + 3 > len(words) - 1:
        raise malformed("the STL file ends within a facet: it was cut off")
    try:
        return np.array([[number(word) for word in words[i + 1 : i + 4]] for i in at], dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise not_numbers("an STL vertex is not three numbers", text) from error


def _loose(corners: Float64Array) -> Geometry:
    if len(corners) % 3:
        raise malformed("an STL facet without three vertices")
    return Geometry(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3))
