"""Wavefront OBJ: vertices and polygons. Everything else is ignored; no other file is opened."""

from __future__ import annotations

import numpy as np

from regnf_core.importing.meshes.geometry import (
    Float64Array,
    Geometry,
    elsewhere,
    malformed,
    not_numbers,
    require_room,
    within_unit,
)

_COMMANDS = (b"call", b"csh")
_NOTED = {b"mtllib": "materials in another file", b"curv": "curves", b"l": "lines", b"p": "points"}
_SURFACE = b"surf"


def read_obj(data: memoryview) -> Geometry:
    """The polygons of an OBJ file, as fans of triangles. Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, or
    MESH_EXTERNAL_REFERENCE for one that would have a command run.
    """
    vertices: list[list[float]] = []
    colors: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    left_out: set[str] = set()
    flat = surfaces = 0
    for line in bytes(data).replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == b"v":
            vertices.append(_place(words))
            colors.extend(_color(words))
        elif words[0] == b"f":
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


def _place(words: list[bytes]) -> list[float]:
    try:
        x, y, z = map(float, words[1:4])  # a fourth number is a weight, more are a color
    except ValueError as error:
        raise not_numbers("an OBJ vertex is not three numbers", b" ".join(words)) from error
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
        number = int(word.partition(b"/")[0])
    except ValueError as error:
        raise malformed("an OBJ face has a corner that is not a number") from error
    if number == 0 or abs(number) >= 1 << 62:
        raise malformed("an OBJ face has a corner of no vertex")
    return number - 1 if number > 0 else so_far + number
