"""Where a person with a camera can walk in a room."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from regnf_core.errors import DatasetError

Array = NDArray[np.float64]

_CELL_M = 0.1
_BODY_M = (0.3, 0.5, 0.75, 1.0, 1.25, 1.5, 1.7)
"""Heights above the floor at which the walker needs room."""
_RADIUS_M = 0.2
_MIN_CELLS = 100
_NEIGHBORS = ((1, 0), (0, 1), (1, 1), (1, -1))


class Distances(Protocol):
    """What tells how far points are from matter."""

    def signed_distance(self, points: Array, /) -> Array:
        """(N,): distance of points (N, 3) to the nearest matter, negative inside."""
        ...


class WalkingGround:
    """Cells of 10 cm that are free from 30 cm to 1.7 m above the floor, all connected.

    floor: (2, 3), lowest and highest corner of the floor's slab. Raises DatasetError (DATASET_NO_FREE_PATH) when less
    than a square meter is free.
    """

    def __init__(self, scene: Distances, floor: Array) -> None:
        axes = [np.arange(floor[0, axis] + _CELL_M, floor[1, axis], _CELL_M) for axis in (0, 1)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)  # (X, Y, 2)
        clearance = np.min([_clearance(scene, grid, floor[1, 2] + height) for height in _BODY_M], axis=0)
        # The edge of the floor bounds the ground as a wall would.
        edge = np.minimum(grid - floor[0, :2], floor[1, :2] - grid).min(axis=-1)
        clearance = np.minimum(clearance, edge)
        areas, _ = ndimage.label(clearance >= _RADIUS_M, structure=np.ones((3, 3)))
        sizes = np.bincount(areas.ravel(), minlength=2)
        largest = int(sizes[1:].argmax()) + 1
        if sizes[largest] < _MIN_CELLS:
            raise DatasetError("there is no room to walk between the furniture", reason="DATASET_NO_FREE_PATH")
        self._free = areas == largest
        self.cells: Array = grid[self._free]
        """(C, 2), meters."""
        self.clearance: Array = clearance[self._free]
        """(C,): distance to the nearest matter at any of the walker's heights."""

    def nearest(self, points: Array) -> Array:
        """The free cells (N, 2) nearest to points (N, 2)."""
        return self.cells[self._index(points)]

    def shortest(self, start: Array, end: Array) -> Array:
        """Cells (P, 2) of the shortest way between two free cells (2,), both included."""
        first, last = self._index(np.stack([start, end]))
        _, before = csgraph.dijkstra(self._graph(), indices=first, return_predecessors=True)
        way = [int(last)]
        while way[-1] != first:
            way.append(int(before[way[-1]]))
        return self.cells[way[::-1]]

    def sides(self) -> list[Array]:
        """The four ways (P, 2) from corner to corner of the ground, each cell the nearest to the straight line."""
        low, high = self.cells.min(axis=0) + _CELL_M, self.cells.max(axis=0) - _CELL_M
        corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
        ends = self.nearest(corners)
        return [self.shortest(ends[side], ends[(side + 1) % 4]) for side in range(4)]

    def clearance_along(self, path: Array) -> Array:
        """(P,): clearance at the cells (P, 2) of a path."""
        return self.clearance[self._index(path)]

    def _index(self, points: Array) -> NDArray[np.int64]:
        gaps = np.linalg.norm(points[:, None] - self.cells[None], axis=2)
        return np.asarray(gaps.argmin(axis=1))

    def _graph(self) -> Any:
        """Which cells adjoin, also across corners, and how far they lie apart."""
        number = np.full(self._free.shape, -1)
        number[self._free] = np.arange(len(self.cells))
        padded = np.pad(number, 1, constant_values=-1)
        links = []
        for down, right in _NEIGHBORS:
            other = padded[1 + down : 1 + down + number.shape[0], 1 + right : 1 + right + number.shape[1]]
            both = (number >= 0) & (other >= 0)
            links.append((number[both], other[both], np.full(int(both.sum()), _CELL_M * np.hypot(down, right))))
        first, second, length = (np.concatenate(parts) for parts in zip(*links, strict=True))
        count = len(self.cells)
        one_way = sparse.coo_array((length, (first, second)), shape=(count, count)).tocsr()
        return one_way + one_way.T


def _clearance(scene: Distances, grid: Array, height: float) -> Array:
    points = np.concatenate([grid.reshape(-1, 2), np.full((grid[..., 0].size, 1), height)], axis=1)
    return scene.signed_distance(points).reshape(grid.shape[:2])
