"""Points and their normals: PCD (Point Cloud Library) as text, binary or compressed, lines of numbers, .npy."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.assumptions import PLACES
from regnf_core.importing.containers.npz import array_header
from regnf_core.importing.containers.plain_text import is_number, number
from regnf_core.importing.containers.sniff import names_places
from regnf_core.importing.meshes.thinning import Thinning, lines_of, numbers_of, parts_of, rows_of_text
from regnf_core.importing.meshes.triangle_files import Float64Array, Geometry, malformed, not_numbers, unsupported

# LZF, the compression of PCD files, by its published layout: literals, and copies of what was unpacked before.

_LITERALS, _LONG = 32, 7
_MOST_UNPACKED = 2 << 30


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


_MAX_HEADER, _MAX_FIELDS, _MAX_COLUMNS = 1 << 14, 64, 1 << 10
_TYPES = {("F", 4): "<f4", ("F", 8): "<f8"} | {
    (sign.upper(), size): f"<{sign}{size}" for sign in ("i", "u") for size in (1, 2, 4, 8)
}
_FORMS = frozenset({"ascii", "binary", "binary_compressed"})
_PLACES, _NORMALS = ("x", "y", "z"), (("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz"))
_NAMES = ((b"x", b"y", b"z"), (b"nx", b"ny", b"nz"), (b"normal_x", b"normal_y", b"normal_z"))
"""Of the place in a line of names, and of the normals."""


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
    """The points of a PCD file. Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE for what unpacks to too much."""
    header = _header(data)
    body = data[header.size :]
    thinning = Thinning(header.points)
    names = [*_PLACES, *next((each for each in _NORMALS if header.counts.keys() >= set(each)), ())]
    if header.data == "ascii":
        rows, read = rows_of_text(body, sum(header.counts.values()), thinning, "PCD")
        if read < header.points:
            raise malformed("the PCD file ends within its points")
        starts = dict(zip(header.counts, np.cumsum([0, *header.counts.values()]), strict=False))
        found = rows[:, [starts[name] for name in names]]
    else:
        if header.data == "binary_compressed":
            table = _columns_of(header, _unpacked(header, body))
        else:
            if header.points * header.row.itemsize > len(body):
                raise malformed("the PCD file ends within its points")
            whole = np.frombuffer(body, header.row, header.points) if header.points else np.zeros(0, header.row)
            table = {name: whole[name][:, 0] for name in header.counts}
        kept = thinning.kept(0, header.points)
        found = np.stack([table[name][kept].astype(np.float64) for name in names], axis=1)
    normals = found[:, 3:] if len(names) > 3 else None
    return Geometry(found[:, :3], np.zeros((0, 3), np.int64), normals, left_out=thinning.left_out, sensor=header.sensor)


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
    named = [name.lower() for name in said.get("FIELDS", said.get("COLUMNS", []))]
    names = [f"{name}{place}" if name == "_" else name for place, name in enumerate(named)]  # "_" is room, repeatedly
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
    singles = {*_PLACES, *(name for each in _NORMALS for name in each)} & types.keys()
    form = " ".join(said["DATA"][:1]).lower()
    if not 0 <= points < 1 << 40 or not all(1 <= count <= _MAX_COLUMNS for count in columns.values()):
        raise malformed("the PCD header has an invalid count")
    if any(columns[name] != 1 for name in singles) or form not in _FORMS:
        raise malformed("the PCD header has an unknown DATA format")
    return _Header(types, columns, points, form, at, _sensor(said))


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
    if size > _MOST_UNPACKED:
        raise FieldFormatError(f"the PCD file unpacks to {size} bytes; save it as binary", reason="MESH_TOO_LARGE")
    return unpack_lzf(body[8 : 8 + packed], size)


def _columns_of(header: _Header, body: memoryview) -> dict[str, Any]:
    """Compressed points lie field by field."""
    table, at = {}, 0
    for name, count in header.counts.items():
        type_ = header.types[name]
        table[name] = np.frombuffer(body, type_, header.points * count, at)[::count]
        at += header.points * count * type_.itemsize
    return table


# Points in lines of numbers: .xyz, .pts, .txt, .csv. A line of names tells the columns; without one the first three are
# the place, and which are the normals is told by their length of one.

_COMMENT = re.compile(rb"(?:#|//|^[ \t]*%)[^\r\n]*", re.MULTILINE)
_DECIMAL_COMMA = re.compile(rb"\d,\d+[ \t;]+-?\d+,\d")
_MOST_COLUMNS = 16
_SEPARATORS = bytes.maketrans(b",;", b"  ")
_FIRST_LINES = 1 << 16
"""Bytes in which the first line of numbers is."""
_ODD = 0.01
"""Share of the lines that may be cut or have other words."""
_UNIT = 0.02
"""How far from one a normal's length may be; of so many ..."""
_SHARE = 0.9
"""... of the points."""


def read_xyz(data: memoryview) -> Geometry:
    """The points of a text file. Raises FieldFormatError: MESH_INVALID."""
    head = bytes(data[:_FIRST_LINES])
    if b"." not in head and _DECIMAL_COMMA.search(head):
        raise not_numbers("the numbers of the points have commas", head)
    words: list[bytes] = []
    names: list[bytes] = []
    start = at = 0
    for line in head.splitlines(keepends=True):
        at += len(line)
        words = _plain(line).split()
        if not names and names_places(words):
            first = [b""] * line.lstrip().startswith((b",", b";"))  # a column of numbers that has no name
            names, start = [*first, *(word.strip(b"\"'").lower() for word in words)], at
        elif len(words) == 1 and not start:  # .pts begins with the number of points
            start = at
        elif words:
            break
    if not 3 <= len(words) <= _MOST_COLUMNS:
        raise malformed(f"lines of {len(words)} numbers are not points")
    if not all(map(is_number, words[:3])):
        raise not_numbers(
            "the first line of the points is not numbers, nor names of columns with x, y and z", head[:80]
        )
    if names and len(names) != len(words):
        raise malformed(f"the point file has {len(names)} names of columns, and {len(words)} numbers in a line")
    body = data[start:]
    thinning = Thinning(lines_of(body))
    rows, odd = _rows_of_lines(body, words, thinning)
    if _are_poses(rows):
        raise malformed("the lines are camera poses (KITTI or TUM), not points; give camera poses with --cameras")
    place, normal = _columns_told(rows, names)
    told = (
        f"order: columns {place[0] + 1} to {place[2] + 1} are x, y, z" if not names else "order: by the line of names"
    )
    if normal is not None and not names:
        told += f", columns {normal[0] + 1} to {normal[2] + 1} are normals, as their length is 1"
    left_out = (*thinning.left_out, *([f"{odd} lines without {len(words)} numbers"] if odd else []))
    normals = None if normal is None else rows[:, normal]
    return Geometry(rows[:, place], np.zeros((0, 3), np.int64), normals, left_out=left_out, assumes=(*PLACES, told))


def _rows_of_lines(body: memoryview, like: list[bytes], thinning: Thinning) -> tuple[Float64Array, int]:
    """The kept rows (K, columns), and how many lines are none. like: the words of the first line; those of its columns
    that are no numbers are read as NaN. Raises FieldFormatError (MESH_INVALID) where many lines are none.
    """
    named = [column for column, word in enumerate(like) if not is_number(word)]
    parts, read, odd = [np.zeros((0, len(like)))], 0, 0
    first_odd = b""
    for part in parts_of(body, "point"):
        text = _plain(part)
        lines = [line for line in text.splitlines() if line.strip()]
        try:
            rows = numbers_of(text, "point").reshape(len(lines), len(like))
        except (FieldFormatError, ValueError):
            sound = []
            for line in lines:
                words = line.split()
                if len(words) == len(like) and all(map(is_number, words[:3])):
                    sound.append([number(word) if is_number(word) else math.nan for word in words])
                else:
                    odd, first_odd = odd + 1, first_odd or line
            rows = np.array(sound, np.float64).reshape(-1, len(like))
        parts.append(rows[thinning.kept(read, read + len(rows))])
        read += len(rows)
    if odd > max(_ODD * (read + odd), 1):
        shown = first_odd[:40].decode("ascii", "replace")
        raise not_numbers(f"{odd} lines of the point file are not {len(like)} numbers, as {shown!r}", first_odd)
    rows = np.concatenate(parts)
    rows[:, named] = np.nan
    return rows, odd


def _columns_told(rows: Float64Array, names: list[bytes]) -> tuple[list[int], list[int] | None]:
    """The columns of the place, and of the normals or None."""
    if names:
        place, *others = ([names.index(name) if name in names else -1 for name in each] for each in _NAMES)
        return place, next((each for each in others if min(each) >= 0), None)
    counted = rows.shape[1] > 3 and len(rows) > 1 and bool((np.diff(rows[:, 0]) == 1.0).all())  # numbers of the rows
    place = [1, 2, 3] if counted else [0, 1, 2]
    first = _normals_at(rows, place[2] + 1)
    return place, None if first is None else [first, first + 1, first + 2]


def _plain(text: bytes) -> bytes:
    """Without comments, and with blanks between the numbers."""
    if b"#" in text or b"//" in text or b"%" in text:
        text = _COMMENT.sub(b"", text)
    return text.translate(_SEPARATORS)


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


def _normals_at(rows: Float64Array, behind: int = 3) -> int | None:
    """The first of three neighboring columns from ``behind`` on whose rows have length one; None: there are none."""
    starts = range(behind, rows.shape[1] - 2)
    return next((start for start in starts if _of_length_one(rows[:, start : start + 3])), None)


# A bare .npy array: (N, 3) points and more columns, as in text; or (H, W, 3), those of an image.


def read_npy(data: memoryview) -> Geometry:
    """The points of an array. Raises FieldFormatError: MESH_INVALID, FORMAT_NOT_SUPPORTED, and what its header may."""
    dtype, shape, fortran_order, start = array_header("the array", data)
    columns = shape[-1] if shape else 0
    table = len(shape) == 2 and 3 <= columns <= _MOST_COLUMNS and columns < shape[0]
    if dtype.kind != "f" or not (table or (len(shape) == 3 and columns == 3)):
        message = f"a single numpy array of {dtype.name}, shape {shape}; a cloud is real numbers of shape (N, 3), or "
        message += "(N, 6) with normals; a grid also needs its origin and spacing: numpy.savez(file, sdf=array, "
        raise unsupported(message + "origin=..., spacing=...)")
    if math.prod(shape) * dtype.itemsize != len(data) - start:
        raise malformed(f"the array has another size than its shape {shape}")
    count = math.prod(shape[:-1])
    thinning = Thinning(count)
    rows = (
        np.frombuffer(data[start:], dtype).reshape(shape, order="F" if fortran_order else "C").reshape(count, columns)
    )
    found = rows[thinning.kept(0, count)].astype(np.float64)
    if _are_poses(found):
        raise malformed("the rows are camera poses, not points; give camera poses with --cameras")
    first = _normals_at(found)
    told = "" if first is None else f", columns {first + 1} to {first + 3} are normals, as their length is 1"
    normals = None if first is None else found[:, first : first + 3]
    assumes = (*PLACES, f"order: columns 1 to 3 are x, y, z{told}")
    return Geometry(found[:, :3], np.zeros((0, 3), np.int64), normals, left_out=thinning.left_out, assumes=assumes)
