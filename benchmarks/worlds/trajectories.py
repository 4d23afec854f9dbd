"""Where cameras stand and what they look at: orbits of an object, walks through a room, one bad view. Meters, z up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from benchmarks.worlds.mesh_scene import MeshScene
from regnf_core.errors import DatasetError

Array = NDArray[np.float64]

# Where a person with a camera can walk in a room.

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
        flat = grid.reshape(-1, 2)
        layers = (np.insert(flat, 2, floor[1, 2] + height, axis=1) for height in _BODY_M)
        clearance = np.min([scene.signed_distance(points) for points in layers], axis=0).reshape(grid.shape[:2])
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


CLEARANCE_M = 0.15
"""A camera's least distance from matter, and from the floor."""
WALK_HEIGHTS_M = (1.5, 0.75)
"""Of the two laps of a long walk; short ones are at the first."""
_RING_STEPS = 10
_RING_MARGIN_M = 0.55
_ELEVATIONS_DEG = (25.0, 50.0, 75.0)
_RING_SHARES = (0.27, 0.3, 0.27, 0.16)
_NEAREST_M = 0.55
_SHORT_ARC_DEG = 130.0
_SMOOTHING = 5
_GAZE_AT_NEAREST = 0.4


def look_at(positions: Array, targets: Array) -> Array:
    """(N, 4, 4): level cameras (OpenCV's axes) at positions (N, 3) that look at targets (N, 3)."""
    forward = targets - positions
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    up = np.where(np.abs(forward[:, 2:]) > 0.999, (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    poses[:, :3, 3] = positions
    return poses


def framing_distance(bounds: Array, half_view: float) -> float:
    """How far from the middle of bounds (2, 3) a camera sees all of it; half_view: radians, the narrower way."""
    return max(1.05 * float(np.linalg.norm(bounds[1] - bounds[0])) / 2.0 / math.sin(half_view), _NEAREST_M)


def orbit(bounds: Array, frames: int, half_view: float, floor: float) -> Array:
    """(frames, 4, 4): rings at four heights round bounds (2, 3), the lowest just above the floor."""
    center = bounds.mean(axis=0)
    distance = framing_distance(bounds, half_view)
    counts = _shared_out(frames, _RING_SHARES)
    rings = []
    for ring, (count, elevation) in enumerate(zip(counts, _elevations(center, distance, floor), strict=True)):
        azimuth = 2.0 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / max(count, 1)
        rings.append(_ring_round(center, distance, azimuth, elevation))
    return np.concatenate(rings)


def pass_by(bounds: Array, frames: int, half_view: float, floor: float) -> Array:
    """(frames, 4, 4): an arc of 130 degrees about the direction +x of bounds (2, 3), at one height."""
    center = bounds.mean(axis=0)
    distance = framing_distance(bounds, half_view)
    half = math.radians(_SHORT_ARC_DEG) / 2.0
    elevation = _elevations(center, distance, floor)[1]
    return _ring_round(center, distance, np.linspace(-half, half, frames), elevation)


def long_walk(ground: WalkingGround, boxes: Sequence[Array], frames: int) -> Array:
    """(frames, 4, 4): two laps at two heights, round every box (2, 3) of furniture in turn, looking at it.

    From one to the next the camera goes by the shortest way through free space.
    """
    laps, tour = _shared_out(frames, (0.5, 0.5)), _tour(ground, boxes)
    return np.concatenate([_walked(*tour, count, at) for count, at in zip(laps, WALK_HEIGHTS_M, strict=True)])


def short_walk(ground: WalkingGround, boxes: Sequence[Array], frames: int) -> Array:
    """(frames, 4, 4): once along the side of the room that is freest, from corner to corner.

    The gaze lies between the middle of all boxes (2, 3) and the nearest one. What faces away is never seen.
    """
    path = max(ground.sides(), key=lambda side: float(ground.clearance_along(side).mean()))
    centers = np.array([box.mean(axis=0) for box in boxes])
    nearest = np.linalg.norm(path[:, None] - centers[None, :, :2], axis=2).argmin(axis=1)
    gaze = (1.0 - _GAZE_AT_NEAREST) * centers.mean(axis=0) + _GAZE_AT_NEAREST * centers[nearest]
    return _walked(path, gaze, frames, WALK_HEIGHTS_M[0])


def _tour(ground: WalkingGround, boxes: Sequence[Array]) -> tuple[Array, Array]:
    """Cells (P, 2) of a walk round every box, the nearest first, and what is watched at each, (P, 3)."""
    left = list(range(len(boxes)))
    here = ground.cells[0]
    path, watched = [], []
    while left:
        chosen = min(left, key=lambda index: float(np.linalg.norm(boxes[index].mean(axis=0)[:2] - here)))
        left.remove(chosen)
        for stop in _ring(ground, boxes[chosen], here):
            leg = ground.shortest(here, stop)
            path.append(leg)
            watched.append(np.tile(boxes[chosen].mean(axis=0), (len(leg), 1)))
            here = stop
    return np.concatenate(path), np.concatenate(watched)


def _ring(ground: WalkingGround, box: Array, start: Array) -> Array:
    """Stops (S, 2) round a box, at the cells nearest to a ring; the first is where the walker comes from."""
    center, half = box.mean(axis=0)[:2], (box[1] - box[0])[:2] / 2.0
    first = math.atan2(*(start - center)[::-1])
    angles = first + 2.0 * np.pi * np.arange(_RING_STEPS + 1) / _RING_STEPS
    ring = center + (np.linalg.norm(half) + _RING_MARGIN_M) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return ground.nearest(ring)


def _walked(path: Array, watched: Array, frames: int, height: float) -> Array:
    """Poses evenly spaced along a path (P, 2), the gaze (P, 3) turning gently from one thing to the next."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    asked = np.linspace(0.0, along[-1], frames)
    positions = np.stack([np.interp(asked, along, path[:, axis]) for axis in (0, 1)], axis=1)
    gaze = np.stack([np.interp(asked, along, watched[:, axis]) for axis in (0, 1, 2)], axis=1)
    padded = np.pad(gaze, ((_SMOOTHING // 2, _SMOOTHING // 2), (0, 0)), mode="edge")
    gaze = np.lib.stride_tricks.sliding_window_view(padded, _SMOOTHING, axis=0).mean(axis=-1)
    return look_at(np.concatenate([positions, np.full((frames, 1), height)], axis=1), gaze)


def _elevations(center: Array, distance: float, floor: float) -> tuple[float, ...]:
    """Of the rings, radians; the lowest as deep as the floor allows, at most 10 degrees below the middle."""
    lowest = -min(math.asin(min(max((center[2] - floor - CLEARANCE_M) / distance, -0.5), 0.5)), math.radians(10.0))
    return (lowest, *np.radians(_ELEVATIONS_DEG).tolist())


def _ring_round(center: Array, distance: float, azimuth: Array, elevation: float) -> Array:
    """(N, 4, 4): cameras at azimuths (N,) and one elevation that look at ``center`` (3,)."""
    level, height = np.cos(elevation), np.full(len(azimuth), np.sin(elevation))
    unit = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=1)
    return look_at(center + distance * unit, np.broadcast_to(center, unit.shape))


def _shared_out(count: int, shares: Sequence[float]) -> list[int]:
    """Whole numbers that sum to ``count``, close to the shares of it."""
    ends = np.round(np.cumsum(shares) / sum(shares) * count).astype(int)
    return [int(count) for count in np.diff(ends, prepend=0)]


def check_free(scene: MeshScene, poses: Array) -> None:
    """Raises DatasetError (DATASET_NO_FREE_PATH) where a camera would be in matter, or touch it."""
    if float(scene.signed_distance(poses[:, :3, 3]).min()) < CLEARANCE_M / 2.0:
        raise DatasetError("a camera would stand in matter", reason="DATASET_NO_FREE_PATH")
