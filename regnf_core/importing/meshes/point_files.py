"""PCD (Point Cloud Library): points and their normals, as text, binary or compressed."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import dataclass, replace

import numpy as np

from regnf_core.importing.assumptions import PLACES
from regnf_core.importing.meshes.triangle_files import Float64Array, Geometry, malformed, not_numbers, require_room

# LZF, the compression of PCD files, by its published layout: literals, and copies of what was unpacked before.

_LITERALS, _LONG = 32, 7


def unpack_lzf(packed: memoryview, size: int) -> memoryview:
    """The ``size`` bytes that ``packed`` holds; never more are made. Raises FieldFormatError (MESH_INVALID)."""
    if size > 264 * len(packed):  # a copy of three bytes makes 264 at most
        raise _faulty()
    source, made = bytes(packed), bytearray()
    at = 0
    try:
        while at < len(source):
            control = source[at]
            at += 1
            if control < _LITERALS:
                made += source[at : at + control + 1]
                at += control + 1
                if at > len(source):
                    raise _faulty()
            else:
                length = control >> 5
                if length == _LONG:
                    length += source[at]
                    at += 1
                back = ((control & 31) << 8 | source[at]) + 1
                at += 1
                start = len(made) - back
                if start < 0:
                    raise _faulty()
                piece = bytes(made[start : start + length + 2])  # it may reach into what is appended
                made += (piece * ((length + 2) // len(piece) + 1))[: length + 2]
            if len(made) > size:
                raise _faulty()
    except IndexError as error:
        raise _faulty() from error
    if len(made) != size:
        raise _faulty()
    return memoryview(bytes(made))


def _faulty() -> Exception:
    return malformed("the PCD file's compressed points have another uncompressed size than the header states")


# Numbers between spaces, as many text formats have them.


def numbers_of(text: bytes, format_: str) -> Float64Array:
    """All numbers of a text. Raises FieldFormatError (MESH_INVALID) where a word is none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return np.fromstring(text.decode("ascii"), dtype=np.float64, sep=" ")
    except (ValueError, DeprecationWarning) as error:
        raise not_numbers(f"the {format_} file holds a word that is not a number", text) from error


_MAX_HEADER, _MAX_FIELDS, _MAX_COLUMNS = 1 << 14, 64, 1 << 10
_TYPES = {("F", 4): "<f4", ("F", 8): "<f8"} | {
    (sign.upper(), size): f"<{sign}{size}" for sign in ("i", "u") for size in (1, 2, 4, 8)
}
_FORMS = frozenset({"ascii", "binary", "binary_compressed"})
_PLACES, _NORMALS = ("x", "y", "z"), ("normal_x", "normal_y", "normal_z")


@dataclass(frozen=True)
class _Header:
    """One row of a point: ``types`` and ``counts`` by name of the field. The header takes ``size`` bytes."""

    types: dict[str, np.dtype[np.generic]]
    counts: dict[str, int]
    points: int
    data: str
    size: int
    sensor: Float64Array | None = None

    @property
    def row(self) -> np.dtype[np.void]:
        return np.dtype([(name, self.types[name], (count,)) for name, count in self.counts.items()])


def read_pcd(data: memoryview) -> Geometry:
    """The points of a PCD file. Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE."""
    header = _header(data)
    require_room(header.points, 0)
    body = data[header.size :]
    if header.data == "binary_compressed":
        table = _from_columns(header, _unpacked(header, body))
    else:
        if header.data == "ascii":  # as if every number were one of float64
            header = replace(header, types=dict.fromkeys(header.types, np.dtype(np.float64)))
            body = numbers_of(bytes(body), "PCD").data.cast("B")
        if header.points * header.row.itemsize > len(body):
            raise malformed("the PCD file ends within its points")
        rows = np.frombuffer(body, header.row, header.points) if header.points else np.zeros(0, header.row)
        table = {name: rows[name][:, 0].astype(np.float64) for name in header.counts}
    normals = np.stack([table[name] for name in _NORMALS], axis=1) if table.keys() >= set(_NORMALS) else None
    points = np.stack([table[name] for name in _PLACES], axis=1)
    return Geometry(points, np.zeros((0, 3), np.int64), normals, sensor=header.sensor)


def _header(data: memoryview) -> _Header:
    said: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in said:
        line, newline, _ = bytes(data[at : at + _MAX_HEADER]).partition(b"\n")
        at += len(line) + 1
        if not newline or at > _MAX_HEADER:
            raise malformed("the PCD header has no end")
        words = line.decode("latin-1").partition("#")[0].split()
        if words:
            said[words[0]] = words[1:]
    names = said.get("FIELDS", [])
    sizes, kinds, counts = (_row(said, key, len(names)) for key in ("SIZE", "TYPE", "COUNT"))
    try:
        types = {name: np.dtype(_TYPES[kind, int(size)]) for name, kind, size in zip(names, kinds, sizes, strict=True)}
        columns = {name: int(count) for name, count in zip(names, counts, strict=True)}
        extents = ("POINTS",) if said.get("POINTS") else ("WIDTH", "HEIGHT")
        points = math.prod(int(said[key][0]) for key in extents)
    except (KeyError, IndexError, ValueError) as error:
        raise malformed("the PCD header has an invalid line") from error
    if len(names) > _MAX_FIELDS or len(types) != len(names) or not types.keys() >= set(_PLACES):
        raise malformed("the PCD header has a field twice, too many fields, or no x, y and z")
    singles = {*_PLACES, *_NORMALS} & types.keys()
    if not 0 <= points < 1 << 40 or not all(1 <= count <= _MAX_COLUMNS for count in columns.values()):
        raise malformed("the PCD header has an invalid count")
    if any(columns[name] != 1 for name in singles) or " ".join(said["DATA"][:1]) not in _FORMS:
        raise malformed("the PCD header has an unknown DATA format")
    return _Header(types, columns, points, said["DATA"][0], at, _sensor(said))


def _sensor(said: dict[str, list[str]]) -> Float64Array | None:
    """(3,): where the sensor stood. The zeros that all writers put for "unknown" count where the points are a depth
    image, row by row: those are in the camera's own frame."""
    try:
        place = np.array([float(word) for word in said.get("VIEWPOINT", [])[:3]])
        rows = int(said.get("HEIGHT", ["1"])[0])
    except (IndexError, ValueError) as error:
        raise malformed("the PCD header has an invalid line") from error
    known = len(place) == 3 and np.isfinite(place).all() and (rows > 1 or place.any())
    return place if known else None


def _row(said: dict[str, list[str]], key: str, count: int) -> list[str]:
    row = said.get(key, ["1"] * count if key == "COUNT" else [])
    if len(row) != count:
        raise malformed(f"the PCD header's {key} has another number of parts than its FIELDS")
    return row


def _unpacked(header: _Header, body: memoryview) -> memoryview:
    packed, size = (int.from_bytes(body[at : at + 4], "little") for at in (0, 4))
    if len(body) < 8 or packed > len(body) - 8 or size != header.points * header.row.itemsize:
        raise malformed("the PCD file's compressed points have another size than the header states")
    return unpack_lzf(body[8 : 8 + packed], size)


def _from_columns(header: _Header, body: memoryview) -> dict[str, Float64Array]:
    """Compressed points lie field by field."""
    table, at = {}, 0
    for name, count in header.counts.items():
        type_ = header.types[name]
        table[name] = np.frombuffer(body, type_, header.points * count, at)[::count].astype(np.float64)
        at += header.points * count * type_.itemsize
    return table


# Points in lines of numbers: .xyz, .pts, .txt. Which columns are the normals is told by their length of one.

_COMMENT = re.compile(rb"(?:#|//)[^\n]*")
_DECIMAL_COMMA = re.compile(rb"\d,\d+[ \t;]+-?\d+,\d")
_MOST_COLUMNS = 16
_UNIT = 0.02
"""How far from one a normal's length may be; of so many ..."""
_SHARE = 0.9
"""... of the points."""


def read_xyz(data: memoryview) -> Geometry:
    """The points of a text file. Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE."""
    text = _COMMENT.sub(b"", bytes(data))
    if b"." not in text and _DECIMAL_COMMA.search(text):
        raise not_numbers("the numbers of the points have commas", text)
    text = text.replace(b",", b" ").replace(b";", b" ").lstrip()
    first, _, rest = text.partition(b"\n")
    if len(first.split()) == 1:  # .pts begins with the number of points
        text = rest.lstrip()
        first = text.partition(b"\n")[0]
    columns = len(first.split())
    if not 3 <= columns <= _MOST_COLUMNS:
        raise malformed(f"lines of {columns} numbers are not points")
    require_room(text.count(b"\n"), 0)
    numbers = numbers_of(text, "point")
    if len(numbers) % columns:
        raise malformed("the lines of the points have different lengths")
    rows = numbers.reshape(-1, columns)
    require_room(len(rows), 0)
    if _are_poses(rows):
        raise malformed("the lines are camera poses (KITTI or TUM), not points; give camera poses with --cameras")
    start = _normals_at(rows)
    normals = None if start is None else rows[:, start : start + 3]
    told = "" if start is None else f", columns {start + 1} to {start + 3} are normals, as their length is 1"
    assumes = (*PLACES, f"order: columns 1 to 3 are x, y, z{told}")
    return Geometry(rows[:, :3], np.zeros((0, 3), np.int64), normals, assumes=assumes)


def _are_poses(rows: Float64Array) -> bool:
    """Whether rows (N, C) are poses: 3x4 matrices (KITTI), or a time, a place and a unit quaternion (TUM)."""
    if rows.shape[1] == 8:
        return _of_length_one(rows[:, 4:])
    turns = rows.reshape(len(rows), 3, 4)[:, :, :3] if rows.shape[1] == 12 else rows[:0]
    if not len(turns):
        return False
    off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    return bool((off < _UNIT).mean() >= _SHARE)


def _of_length_one(rows: Float64Array) -> bool:
    return len(rows) > 0 and bool((np.abs(np.linalg.norm(rows, axis=1) - 1.0) < _UNIT).mean() >= _SHARE)


def _normals_at(rows: Float64Array) -> int | None:
    """The first of three neighboring columns behind the place whose rows have length one; None: there are none."""
    starts = range(3, rows.shape[1] - 2)
    return next((start for start in starts if _of_length_one(rows[:, start : start + 3])), None)
