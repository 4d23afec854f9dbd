"""Similarities as rows of plain numbers: the check that files and descriptions share. Neither torch nor numpy."""

from __future__ import annotations

from collections.abc import Sequence

_UNSIMILAR = 1e-4
"""Of the squared scale: how far a similarity's rows may be from orthogonal and equally long."""
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
