"""Slow interpolation, one point and one corner after the other in float64: what the fast evaluation is held against."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Lookup = Callable[[tuple[int, int, int]], float]


def slow_trilinear(value_at: Lookup, position: Array) -> float:
    """The value at ``position`` (3,) in lattice units, with ``value_at`` (i, j, k) giving a node's."""
    cell = np.floor(position)
    share = position - cell
    total = 0.0
    for corner in itertools.product((0, 1), repeat=3):
        weight = np.prod([share[axis] if corner[axis] else 1.0 - share[axis] for axis in range(3)])
        total += weight * value_at(tuple(int(c) + k for c, k in zip(cell, corner, strict=True)))
    return float(total)
