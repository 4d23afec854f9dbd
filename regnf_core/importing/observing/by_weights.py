"""The observation of a map made by fusion, from the weights that it keeps: zero where no depth image had a say.

A cell lies between eight nodes. With a weight at all of them it was observed: a surface runs through it where their
values differ in sign, it is free where all are positive, and matter behind a surface, which nobody saw, elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.importing.arrays import StoredArray
from regnf_core.schema.description import FARTHEST, FREE, MAX_COUNT, SURFACE, UNSEEN, ObservationGrid
from regnf_core.schema.kinds import WEIGHTS

Cells = tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]
"""Middles (M, 3) of cells, in the coordinates of the kind's function, and their states (M,)."""
_CELLS_ACROSS = 2
"""Cells of the map that a voxel is across at least: a sample a little off the surface stays in the surface's voxel."""
_MOST_VOXELS = 1 << 24
_CELLS_AT_ONCE = 1 << 21


def observed_by_weights(
    description: Mapping[str, Any], tensors: Mapping[str, StoredArray]
) -> tuple[ObservationGrid, npt.NDArray[np.int32]] | None:
    """What the weights among ``tensors`` say was observed, as a field file keeps it; None where there are none, or
    where the map lies farther from the origin than an observation may."""
    if WEIGHTS not in tensors or description["kind"] not in ("voxel_blocks", "voxel_grid"):
        return None
    low, high, step = _extent(description, tensors)
    if max(abs(low).max(), abs(high).max()) > FARTHEST:
        return None
    voxel = _voxel(high - low, _CELLS_ACROSS * step)
    counts = np.maximum(np.ceil((high - low) / voxel - 1e-9), 1).astype(np.int64)
    free = np.zeros(int(counts.prod()), np.int32)
    surface = np.zeros(free.size, np.bool_)
    cells = np.zeros(free.size, np.int32)
    each = _cells_of_blocks if "blocks" in tensors else _cells_of_grid
    for middles, states in each(description, tensors):
        within = ((middles > low) & (middles < high)).all(axis=1)
        index = np.minimum(np.floor((middles[within] - low) / voxel).astype(np.int64), counts - 1)
        flat = np.ravel_multi_index(tuple(index.T), tuple(counts))
        surface[flat[states[within] == SURFACE]] = True
        free += np.bincount(flat[states[within] == FREE], minlength=free.size).astype(np.int32)
        cells += np.bincount(flat, minlength=free.size).astype(np.int32)
    states = np.where((free > 0) & (2 * free >= cells), np.uint8(FREE), np.uint8(UNSEEN))
    states[surface] = SURFACE
    x, y, z = (int(count) for count in counts)
    grid = ObservationGrid((float(low[0]), float(low[1]), float(low[2])), voxel, (x, y, z))
    return grid, grid.pack(states.reshape(x, y, z))


def _extent(
    description: Mapping[str, Any], tensors: Mapping[str, StoredArray]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], float]:
    """Lowest and highest corner of the nodes with a weight, and the longest edge of a cell."""
    origin, seen = np.array(description.get("origin", (0.0, 0.0, 0.0)), np.float64), tensors[WEIGHTS] > 0
    if description["kind"] == "voxel_grid":
        spacing = np.array(description["spacing"], np.float64)
        ranges = [np.flatnonzero(seen.any(axis=others))[[0, -1]] for others in ((1, 2), (0, 2), (0, 1))]
        first, last = np.array(ranges, np.float64).T
        return origin + spacing * first, origin + spacing * last, float(spacing.max())
    from regnf_core.importing.containers.euclidean import seen_extent

    low, high = seen_extent(tensors["blocks"].astype(np.int64), seen)
    size = float(description["voxel_size"])
    return origin + size * low, origin + size * high, size


def _voxel(extent: npt.NDArray[np.float64], least: float) -> float:
    """The edge of a voxel: ``least``, or as much more as the grid's limits ask."""
    voxel = max(least, float(extent.max()) / MAX_COUNT)
    while math.prod(math.ceil(length / voxel) for length in np.maximum(extent, voxel)) > _MOST_VOXELS:
        voxel *= 1.1
    return voxel


def _cells_of_grid(description: Mapping[str, Any], tensors: Mapping[str, StoredArray]) -> Iterator[Cells]:
    """A few layers of nodes at once."""
    values, weights = tensors["values"], tensors[WEIGHTS]
    origin, spacing = (np.array(description[name], np.float64) for name in ("origin", "spacing"))
    layers = max(1, _CELLS_AT_ONCE // int(np.prod(values.shape[1:])))
    for start in range(0, values.shape[0] - 1, layers):
        part = slice(start, start + layers + 1)
        states = _states(values[None, part] * description.get("sign", 1), weights[None, part] > 0)[0]
        index = np.indices(states.shape).reshape(3, -1).T + np.array([start, 0, 0])
        yield origin + spacing * (index + 0.5), states.ravel()


def _cells_of_blocks(description: Mapping[str, Any], tensors: Mapping[str, StoredArray]) -> Iterator[Cells]:
    """A few blocks at once, each with the first nodes of those beyond it."""
    blocks = tensors["blocks"].astype(np.int64)
    edge = tensors["values"].shape[1]
    origin, size = np.array(description.get("origin", (0.0, 0.0, 0.0)), np.float64), float(description["voxel_size"])
    rows = {tuple(block): row for row, block in enumerate(blocks.tolist())}
    within = np.indices((edge, edge, edge)).reshape(3, -1).T + 0.5
    at_once = max(1, _CELLS_AT_ONCE // edge**3)
    for start in range(0, len(blocks), at_once):
        chosen = blocks[start : start + at_once]
        values, seen = _with_next(tensors, rows, chosen, edge)
        states = _states(values * description.get("sign", 1), seen)
        middles = (edge * chosen)[:, None] + within
        yield origin + size * middles.reshape(-1, 3), states.ravel()


def _with_next(
    tensors: Mapping[str, StoredArray], rows: Mapping[tuple[int, ...], int], chosen: npt.NDArray[np.int64], edge: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Values and whether there is a weight, (C, R + 1, R + 1, R + 1), of blocks and the first nodes beyond them."""
    shape = (len(chosen), edge + 1, edge + 1, edge + 1)
    values, seen = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
    for offset in np.ndindex(2, 2, 2):
        found = [rows.get((x + offset[0], y + offset[1], z + offset[2]), -1) for x, y, z in chosen.tolist()]
        row = np.array(found)
        here = np.flatnonzero(row >= 0)
        into = tuple(slice(edge, None) if beyond else slice(0, edge) for beyond in offset)
        out_of = tuple(slice(0, 1) if beyond else slice(None) for beyond in offset)
        values[(here, *into)] = tensors["values"][(row[here], *out_of)]
        seen[(here, *into)] = tensors[WEIGHTS][(row[here], *out_of)] > 0
    return values, seen


def _states(values: npt.NDArray[Any], seen: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """The states (C, X - 1, Y - 1, Z - 1) of the cells between nodes (C, X, Y, Z)."""
    inside = values < 0
    cells = tuple(length - 1 for length in values.shape[1:])
    every, some_inside, all_inside = (np.full((len(values), *cells), first) for first in (True, False, True))
    for offset in np.ndindex(2, 2, 2):
        corner = (slice(None), *(slice(at, at + count) for at, count in zip(offset, cells, strict=True)))
        every &= seen[corner]
        some_inside |= inside[corner]
        all_inside &= inside[corner]
    states = np.full(every.shape, UNSEEN, np.uint8)
    states[every & ~some_inside] = FREE
    states[every & some_inside & ~all_inside] = SURFACE
    return states
