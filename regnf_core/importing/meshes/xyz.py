"""Points in lines of numbers: .xyz, .pts, .txt. Which columns are the normals is told by their length of one."""

from __future__ import annotations

import re

import numpy as np

from regnf_core.importing.meshes.geometry import Float64Array, Geometry, malformed, require_room
from regnf_core.importing.meshes.number_text import numbers_of

_COMMENT = re.compile(rb"(?:#|//)[^\n]*")
_MOST_COLUMNS = 16
_UNIT = 0.02
"""How far from one a normal's length may be; of so many ..."""
_SHARE = 0.9
"""... of the points."""


def read_xyz(data: memoryview) -> Geometry:
    """The points of a text file. Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE."""
    text = _COMMENT.sub(b"", bytes(data)).replace(b",", b" ").replace(b";", b" ").lstrip()
    first, _, rest = text.partition(b"\n")
    if len(first.split()) == 1:  # .pts begins with the number of points
        text = rest.lstrip()
        first = text.partition(b"\n")[0]
    columns = len(first.split())
    if not 3 <= columns <= _MOST_COLUMNS:
        raise malformed(f"lines of {columns} numbers are no points")
    require_room(text.count(b"\n"), 0)
    numbers = numbers_of(text, "point")
    if len(numbers) % columns:
        raise malformed("the points' lines are not of one length")
    rows = numbers.reshape(-1, columns)
    require_room(len(rows), 0)
    return Geometry(rows[:, :3], np.zeros((0, 3), np.int64), _normals(rows))


def _normals(rows: Float64Array) -> Float64Array | None:
    """The three neighboring columns behind the place whose rows have length one; None where there are none."""
    for start in range(3, rows.shape[1] - 2):
        found = rows[:, start : start + 3]
        if len(rows) and (np.abs(np.linalg.norm(found, axis=1) - 1.0) < _UNIT).mean() >= _SHARE:
            return found
    return None
