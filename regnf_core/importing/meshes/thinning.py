"""Clouds of many points: about two million of them are kept while the file is read, for a surface shows no more.

One of each few consecutive points is kept, at a position among them that changes: every n-th point of a scan that lies
row by row would be of few columns.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from regnf_core.importing.containers.plain_text import plain_numbers
from regnf_core.importing.meshes.triangle_files import Float64Array, Int64Array, malformed, not_numbers

MOST_KEPT = 2_000_000
"""Points, about."""
_GOLDEN = (5.0**0.5 - 1.0) / 2.0
_AT_ONCE = 1 << 24
"""Bytes of text."""


@dataclass(frozen=True)
class Thinning:
    """Which of ``count`` points are kept: one of each ``step``."""

    count: int

    @property
    def step(self) -> int:
        return max(1, math.ceil(self.count / MOST_KEPT))

    @property
    def left_out(self) -> tuple[str, ...]:
        """What a reader says of it."""
        return (f"{self.step - 1} of each {self.step} points",) if self.step > 1 else ()

    def kept(self, start: int, stop: int) -> Int64Array:
        """The numbers, counted from ``start``, of the points that are kept among those from ``start`` to ``stop``."""
        groups = np.arange(start // self.step, -(-stop // self.step))
        place = groups * self.step + np.floor(groups * _GOLDEN % 1.0 * self.step).astype(np.int64)
        kept: Int64Array = place[(place >= start) & (place < stop)] - start
        return kept


def numbers_of(text: bytes, format_: str) -> Float64Array:
    """All numbers of a text. Raises FieldFormatError (MESH_INVALID) where a word is none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                return np.fromstring(text.decode("ascii"), dtype=np.float64, sep=" ")
            except (ValueError, DeprecationWarning):
                return np.fromstring(plain_numbers(text).decode("ascii"), dtype=np.float64, sep=" ")
    except (ValueError, DeprecationWarning) as error:
        raise not_numbers(f"the {format_} file holds a word that is not a number", text) from error


def parts_of(text: memoryview, format_: str) -> Iterator[bytes]:
    """Whole lines, some megabytes at a time. Raises FieldFormatError (MESH_INVALID) for a line that is longer."""
    at = 0
    while at < len(text):
        part = bytes(text[at : at + _AT_ONCE])
        end = len(part) if at + len(part) == len(text) else max(part.rfind(b"\n"), part.rfind(b"\r")) + 1
        if end == 0:
            raise malformed(f"the {format_} file has a line of more than {_AT_ONCE} bytes")
        at += end
        yield part[:end]


def rows_of_text(text: memoryview, columns: int, thinning: Thinning, format_: str) -> tuple[Float64Array, int]:
    """The kept ones (K, columns) of the rows of a text, and how many rows there are; at most ``thinning.count`` are
    read, a part of the text at a time.

    Raises FieldFormatError (MESH_INVALID) where a word is no number.
    """
    parts = [np.zeros((0, columns))]
    read = 0
    left = np.zeros(0)
    for part in parts_of(text, format_):
        if read >= thinning.count:
            break
        numbers = np.concatenate([left, numbers_of(part, format_)])
        whole = min(len(numbers) // columns, thinning.count - read)
        left = numbers[whole * columns :]
        rows = numbers[: whole * columns].reshape(-1, columns)
        parts.append(rows[thinning.kept(read, read + whole)])
        read += whole
    if len(left) and read < thinning.count:
        raise malformed(f"the lines of the {format_} file have different lengths")
    return np.concatenate(parts), read


def lines_of(text: memoryview) -> int:
    """How many lines a text has, a last one without an end included."""
    return 1 + sum(bytes(text[at : at + _AT_ONCE]).count(b"\n") for at in range(0, len(text), _AT_ONCE))
