"""OFF (Geomview), text and binary: vertices, their normals and colors, polygons. Texture coordinates are ignored."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from regnf_core.importing.meshes.geometry import (
    Float64Array,
    Geometry,
    Int64Array,
    fan,
    fans,
    malformed,
    not_numbers,
    require_room,
    unsupported,
    within_unit,
)

_MAGIC = re.compile(rb"(?:#[^\n]*\n\s*)*(ST)?(C)?(N)?(4)?(n)?OFF(?:[ \t]*BINARY)?")
_MAX_CORNERS, _MAX_COLORS = 255, 8
_MOST_HEAD = 16 * 1024  # comments may stand before the magic word
_TRIANGLE_INTS = 5


def read_off(data: memoryview) -> Geometry:
    """The polygons of an OFF file, as fans of triangles. Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, or
    FORMAT_NOT_SUPPORTED for one of another dimension than three.
    """
    head = bytes(data[:_MOST_HEAD])
    magic = _MAGIC.match(head)
    if magic is None:
        raise malformed("no OFF file")
    texture, color, normal, four, any_dimension = (group is not None for group in magic.groups())
    if four or any_dimension:
        raise unsupported("an OFF file of other than three dimensions")
    if magic.group().endswith(b"BINARY"):
        line = head.find(b"\n", magic.end())
        if line < 0:
            raise malformed("an OFF file that ends within its first line")
        return _binary(data[line + 1 :], 3 + 3 * normal + 4 * color + 2 * texture, normal, color)
    return _text(bytes(data[magic.end() :]), normal, color)


def _text(text: bytes, normal: bool, color: bool) -> Geometry:
    lines = _lines(text)
    vertices, faces = _counts([int(_number(word)) for word in next(lines, [])[:3]])
    places, colors = [], []
    for _ in range(vertices):
        words = next(lines, [])
        places.append(_places(words, normal))
        colors.extend(_color(words[6 if normal else 3 :]) if color else [])
    triangles: list[tuple[int, int, int]] = []
    for _ in range(faces):
        corners = _corners(next(lines, []))
        triangles.extend((corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1))
        require_room(vertices, len(triangles))
    table = np.array(places, dtype=np.float64).reshape(vertices, 6 if normal else 3)
    painted = np.array(colors) if colors and len(colors) == vertices else None
    return _geometry(table, np.array(triangles, dtype=np.int64).reshape(-1, 3), normal, painted)


def _lines(text: bytes) -> Iterator[list[bytes]]:
    """The words of every line that says something."""
    for line in text.splitlines():
        words = line.partition(b"#")[0].split()
        if words:
            yield words


def _counts(numbers: list[int]) -> tuple[int, int]:
    if len(numbers) < 2 or min(numbers) < 0:
        raise malformed("an OFF file without the numbers of its vertices and faces")
    require_room(numbers[0], numbers[1])
    return numbers[0], numbers[1]


def _places(words: list[bytes], normal: bool) -> list[float]:
    wanted = 6 if normal else 3
    if len(words) < wanted:
        raise malformed("an OFF vertex of too few numbers, or none")
    return [_number(word) for word in words[:wanted]]


def _corners(words: list[bytes]) -> list[int]:
    count = int(_number(words[0])) if words else 0
    if not 1 <= count <= _MAX_CORNERS or len(words) <= count:
        raise malformed("an OFF face of too few corners, or none")
    return [int(_number(word)) for word in words[1 : count + 1]]


def _number(word: bytes) -> float:
    try:
        number = float(word)
    except ValueError as error:
        raise not_numbers("an OFF file holds a word that is not a number", word) from error
    if not abs(number) < 1e300:
        raise malformed("an OFF file holds a number that is not finite")
    return number


def _color(words: list[bytes]) -> list[list[float]]:
    """The first three numbers, if there are so many; whole ones are shares of 255."""
    try:
        numbers = [float(word) for word in words[:3]]
    except ValueError:
        return []
    top = 1.0 if any(b"." in word for word in words[:3]) else 255.0
    return [[number / top for number in numbers]] if len(numbers) == 3 else []


def _binary(data: memoryview, columns: int, normal: bool, color: bool) -> Geometry:
    if len(data) < 12:
        raise malformed("an OFF file without the numbers of its vertices and faces")
    vertices, faces = _counts(np.frombuffer(data[:12], ">i4").tolist())
    size = 4 * columns * vertices
    if 12 + size > len(data):
        raise malformed("the OFF file ends within its vertices")
    table = np.frombuffer(data[12 : 12 + size], ">f4").reshape(vertices, columns).astype(np.float64)
    start = 6 if normal else 3
    return _geometry(
        table, _binary_faces(data[12 + size :], faces), normal, table[:, start : start + 3] if color else None
    )


def _binary_faces(data: memoryview, faces: int) -> Int64Array:
    size = 4 * _TRIANGLE_INTS * faces
    if size <= len(data):
        rows = np.frombuffer(data[:size], ">i4").reshape(faces, _TRIANGLE_INTS)
        if (rows[:, 0] == 3).all() and (rows[:, 4] == 0).all():
            return fans(rows[:, 1:4])
    found: list[Int64Array] = []
    at = triangles = 0
    for _ in range(faces):
        count = int.from_bytes(data[at : at + 4], "big")
        end = at + 4 + 4 * count
        colors = int.from_bytes(data[end : end + 4], "big") if count <= _MAX_CORNERS else 0
        if not 1 <= count <= _MAX_CORNERS or colors > _MAX_COLORS or end + 4 + 4 * colors > len(data):
            raise malformed("the OFF file has a face of no corners or too many, or ends within its faces")
        found.append(fan(np.frombuffer(data[at + 4 : end], ">i4")))
        triangles += max(count - 2, 0)
        require_room(0, triangles)
        at = end + 4 + 4 * colors
    return np.concatenate(found) if found else np.zeros((0, 3), np.int64)


def _geometry(table: Float64Array, triangles: Int64Array, normal: bool, colors: Float64Array | None) -> Geometry:
    painted = None if colors is None else within_unit(colors)
    return Geometry(table[:, :3], triangles, table[:, 3:6] if normal else None, painted)
