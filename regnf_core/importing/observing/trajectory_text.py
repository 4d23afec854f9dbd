"""Poses as plain numbers: a file of TUM's (timestamp tx ty tz qx qy qz qw), or a folder with a matrix a file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from regnf_core.importing.observing.trajectory import MOST_CAMERAS, Array, malformed
from regnf_core.importing.settings.plain import MAX_NUMBER_CHARACTERS, decoded

MOST_BYTES = 8 << 20
_TUM = 8
_NUMBERS = re.compile(r"[0-9]+")
_SEPARATORS = re.compile(r"[\s,;]+")
_CELLS = re.compile(r"[;\t]")


def read_tum(name: str, data: bytes | memoryview) -> Array | None:
    """The poses (N, 4, 4), camera to world, of a file with eight numbers a line; None where it is none.

    Lines that are empty or begin with # are passed over. Raises FieldFormatError (CAMERAS_MALFORMED).
    """
    rows = _rows(name, data)
    if not rows or any(len(row) != _TUM for row in rows):
        return None
    values = np.array(rows, np.float64)
    with np.errstate(all="ignore"):
        length = np.linalg.norm(values[:, 4:], axis=1, keepdims=True)
        x, y, z, w = (values[:, 4:] / length).T
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, 3] = values[:, 1:4]
    poses[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], 1)
    poses[:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], 1)
    poses[:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], 1)
    return poses


def read_matrices(files: Sequence[tuple[str, bytes | memoryview]]) -> tuple[Array | None, Array | None]:
    """The poses (N, 4, 4) of files with a 4 x 4 or 3 x 4 matrix each, by the numbers in their names, and the 3 x 3 or
    4 x 4 matrix of the one file whose name says ``intrinsic``. None where there are none.

    Raises FieldFormatError (CAMERAS_MALFORMED).
    """
    poses, intrinsics = [], None
    if len(files) > MOST_CAMERAS:
        raise malformed(f"more than {MOST_CAMERAS} files of poses")
    for name, data in sorted(files, key=lambda file: _order(file[0])):
        rows = _rows(name, data)
        if "intrinsic" in PurePosixPath(name).name.lower():
            if len(rows) < 3 or any(len(row) != len(rows[0]) or len(row) < 3 for row in rows):
                raise malformed(f"{name} holds no 3 x 3 matrix")
            intrinsics = np.array(rows, np.float64)[:3, :3]
        elif len(rows) in (3, 4) and all(len(row) == 4 for row in rows):
            poses.append(np.array([*rows, [0.0, 0.0, 0.0, 1.0]][:4], np.float64))
    return (np.stack(poses) if poses else None), intrinsics


def _rows(name: str, data: bytes | memoryview) -> list[list[float]]:
    """The lines' numbers; NaN and infinity are such, as trackers write them for a camera that they have lost."""
    lines = (line.strip() for line in decoded(name, data, MOST_BYTES).splitlines())
    words = (_words(line) for line in lines if line and not line.startswith("#"))
    return [[_number(name, word) for word in line] for line in words]


def _words(line: str) -> list[str]:
    """A line's numbers. A spreadsheet that writes decimal commas parts them by semicolons or tabs."""
    cells = _CELLS.split(line)
    if len(cells) > 1 and "." not in line and all(cell.count(",") <= 1 for cell in cells):
        line = line.replace(",", ".")
    return [word for word in _SEPARATORS.split(line) if word]


def _number(name: str, word: str) -> float:
    try:
        if len(word) <= MAX_NUMBER_CHARACTERS:
            return float(word)
    except ValueError:
        pass
    raise malformed(f"{name}: {word[:MAX_NUMBER_CHARACTERS]!r} is no number")


def _order(name: str) -> tuple[list[int], str]:
    return [int(number[:18]) for number in _NUMBERS.findall(PurePosixPath(name).name)[:8]], name
