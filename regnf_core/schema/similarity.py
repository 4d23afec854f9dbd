"""Similarities as rows of plain numbers: the check that files and descriptions share. Neither torch nor numpy."""

from __future__ import annotations

import math
from collections.abc import Sequence

_UNSIMILAR = 1e-4
"""Of the squared scale: how far a similarity's rows may be from orthogonal and equally long."""
_NEAR = 8.0
"""A box within so many of its diagonals of the origin: float32, of 24 bits, keeps places to 5e-7 of the diagonal."""
Rows = Sequence[Sequence[float]]


def require_similarity(rows: Rows) -> None:
    """Raise ValueError unless the 4 x 4 ``rows`` are a rotation times one positive factor, and a shift."""
    linear = [row[:3] for row in rows[:3]]
    (a, b, c), (d, e, f), (g, h, i) = linear
    volume = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    square = max(volume, 0.0) ** (2 / 3)
    products = [[sum(x * y for x, y in zip(u, v, strict=True)) - square * (u is v) for v in linear] for u in linear]
    if not 0 < square < 1e300 or not max(abs(value) for row in products for value in row) <= _UNSIMILAR * square:
        raise ValueError("is not a rotation times one positive factor")
    if tuple(rows[3]) != (0.0, 0.0, 0.0, 1.0):
        raise ValueError("its last row is not 0 0 0 1")


def moved_box(rows: Rows, box: Rows) -> list[list[float]]:
    """Lowest and highest corner of the box round ``box`` after the similarity."""
    low, high = [], []
    for *linear, shift in rows[:3]:
        ends = [sorted((factor * a, factor * b)) for factor, a, b in zip(linear, *box, strict=True)]
        low.append(shift + sum(end[0] for end in ends))
        high.append(shift + sum(end[1] for end in ends))
    return [low, high]


def local_origin(box: Rows) -> tuple[float, float, float] | None:
    """The place near the middle of a far ``box`` that is to be subtracted, in float64, before anything is float32.

    It is a multiple of a power of two, so that the subtraction is exact. None: the box lies near the origin.
    """
    diagonal = math.dist(*box)
    reach = max(abs(value) for corner in box for value in corner)
    if not 0.0 < diagonal < math.inf or reach <= _NEAR * diagonal:
        return None
    step = 2.0 ** math.floor(math.log2(diagonal))
    x, y, z = (step * round((low + high) / 2.0 / step) for low, high in zip(*box, strict=True))
    return x, y, z


def shift_rows(shift: Sequence[float]) -> list[list[float]]:
    return [[*(float(row == column) for column in range(3)), value] for row, value in enumerate(shift)] + [
        [0.0, 0.0, 0.0, 1.0]
    ]


def product(first: Rows, second: Rows) -> list[list[float]]:
    """The 4 x 4 rows of ``first`` after ``second``."""
    return [
        [sum(a * b for a, b in zip(row, column, strict=True)) for column in zip(*second, strict=True)] for row in first
    ]
