"""Which frames of a recording are worth reading, and where its surfaces lie."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError
from regnf_data.recordings.camera import Array
from regnf_data.recordings.recording import Frame, Recording

if TYPE_CHECKING:
    from regnf_core.geometry.box import OrientedBox

_LOOKED_AT = 240
"""Frames whose depths are looked at, evenly spread over the recording."""
_LOOKED_AT_EACH = 4
"""Frames whose depths are looked at for each that is wanted, of those whose cameras look at the box."""
_FAR = 3.0
"""Times as far from the box as the nearer cameras: farther frames show little of it."""
_POINTS = 4_000
"""Of each such frame."""
_CELLS_ACROSS = 64
"""Of the recording's extent, or of the box's longest side: a cell that a frame sees is worth half of what it was worth
before another one saw it."""
_LEAST_GAIN = 0.002
"""Of all that the chosen frames show so far: frames that add less are left out."""
_OUTLIERS = 0.005
"""The share of the cells, at each end of an axis, outside the bounds: flying pixels, views through windows."""
_MARGIN = 0.02
"""Of the extent, around it."""


@dataclass(frozen=True, eq=False)
class Chosen:
    """indices: of the frames, in their order · bounds: (2, 3), world, of what they show."""

    indices: tuple[int, ...]
    bounds: Array


def choose_frames(
    recording: Recording,
    most: int = 80,
    box: OrientedBox | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Chosen:
    """At most ``most`` frames, by what they add. box: what lies outside does not count, the nearer frame sees more, and
    only frames whose cameras look at it are read.

    Frames that cannot be read are an error. Raises DatasetError: DATASET_DEPTH_MISSING where no frame has a depth,
    DATASET_NOTHING_IN_BOUNDS where none shows a surface in the box.
    """
    places = list(range(len(recording))) if box is None else _looking_at(recording, box)
    count = min(len(places), _LOOKED_AT if box is None else _LOOKED_AT_EACH * most)
    looked_at = [places[(index * len(places)) // count] for index in range(count)]
    seen: list[tuple[Array, float]] = []
    for number, index in enumerate(looked_at):
        if progress is not None:
            progress(number, count)
        frame = recording.frames[index].read(color=False)
        seen.append((_some_points(frame), _sharpness(frame, box)))
    points = [each for each, _ in seen]
    if not sum(map(len, points)):
        raise DatasetError(f"{recording.name}: no frame has a measured depth", reason="DATASET_DEPTH_MISSING")
    bounds = _bounds(np.concatenate(points))
    if box is not None:
        points = [each[_inside(box, each)] for each in points]
        if not sum(map(len, points)):
            raise DatasetError(
                f"{recording.name}: no frame shows a surface in the box", reason="DATASET_NOTHING_IN_BOUNDS"
            )
    edge = float((bounds[1] - bounds[0]).max() if box is None else box.size.max()) / _CELLS_ACROSS
    # Two frames of a room see a wall alike; of an object in a box, the one with the narrower pixels counts for more.
    worth = [1.0 if box is None else sharp for _, sharp in seen]
    picked = _greedy([_cells(each, edge) for each in points], worth, most)
    return Chosen(tuple(sorted(looked_at[each] for each in picked)), bounds)


def _some_points(frame: Frame) -> Array:
    """World points of at most some 4,000 pixels, on a regular grid."""
    stride = max(1, int(np.sqrt(frame.depth.size / _POINTS)))
    depth = frame.depth[::stride, ::stride]
    rows, columns = np.nonzero(depth > 0.0)
    rays = frame.camera.rays(np.stack([columns * stride + 0.5, rows * stride + 0.5], axis=1))
    local = rays * depth[rows, columns][:, None]
    return local @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]


def _looking_at(recording: Recording, box: OrientedBox) -> list[int]:
    """Frames whose cameras have a part of the box before them, by their poses alone; all of them where none has."""
    poses = np.stack([frame.T_world_camera for frame in recording.frames])
    K = np.stack([frame.camera.K for frame in recording.frames])
    sides = np.array([(frame.camera.size or 2.0 * frame.camera.K[[1, 0], 2])[::-1] for frame in recording.frames])
    local = np.einsum("nji,nj->ni", poses[:, :3, :3], box.center.numpy() - poses[:, :3, 3])
    depth = np.maximum(local[:, 2], 1e-9)
    pixels = local[:, :2] / depth[:, None] * K[:, [0, 1], [0, 1]] + K[:, :2, 2]
    around = (box.diagonal / 2.0 * K[:, 0, 0] / depth)[:, None]
    looking = (local[:, 2] > 0.0) & ((pixels > -around) & (pixels < sides + around)).all(axis=1)
    if not looking.any():
        return list(range(len(recording)))
    near = np.linalg.norm(local, axis=1)
    return [int(index) for index in np.flatnonzero(looking & (near <= _FAR * np.quantile(near[looking], 0.1)))]


def _sharpness(frame: Frame, box: OrientedBox | None) -> float:
    """Pixels a meter, at the box or at the nearer part of what the frame shows."""
    if box is not None:
        apart = float(np.linalg.norm(box.center.numpy() - frame.T_world_camera[:3, 3]))
        return float(frame.camera.K[0, 0]) / max(apart, 1e-9)
    measured = frame.depth[frame.depth > 0.0]
    return float(frame.camera.K[0, 0] / np.quantile(measured, 0.25)) if len(measured) else 0.0


def _inside(box: OrientedBox, points: Array) -> NDArray[np.bool_]:
    local = (points - box.center.numpy()) @ box.rotation.numpy()
    return np.asarray((np.abs(local) <= box.size.numpy() / 2.0).all(axis=1))


def _bounds(points: Array) -> Array:
    """(2, 3): of the points' cells, without the outermost ones."""
    spread = np.quantile(points, 0.99, axis=0) - np.quantile(points, 0.01, axis=0)
    cells = np.unique(np.floor(points / max(float(spread.max()) / _CELLS_ACROSS, 1e-9)).astype(np.int64), axis=0)
    edge = max(float(spread.max()) / _CELLS_ACROSS, 1e-9)
    low, high = (np.quantile(cells * edge, share, axis=0) for share in (_OUTLIERS, 1.0 - _OUTLIERS))
    margin = _MARGIN * float((high - low).max()) + edge
    return np.stack([low - margin, high + edge + margin])


def _cells(points: Array, edge: float) -> NDArray[np.int64]:
    """One number for each cell that holds a point."""
    cells = np.floor(points / edge).astype(np.int64)
    return np.unique(cells @ np.array([1, 1 << 21, 1 << 42], np.int64))


def _greedy(cells: list[NDArray[np.int64]], worth: list[float], most: int) -> list[int]:
    """Frames in the order of what they add: each time a cell is seen, seeing it again is worth half as much."""
    known, places = np.unique(np.concatenate(cells), return_inverse=True)
    each = np.split(places, np.cumsum([len(one) for one in cells])[:-1])
    left = np.ones(len(known))
    picked: list[int] = []
    total = 0.0
    while len(picked) < min(most, len(cells)):
        gains = [0.0 if index in picked else worth[index] * float(left[one].sum()) for index, one in enumerate(each)]
        best = int(np.argmax(gains))
        if gains[best] <= _LEAST_GAIN * total:
            break
        total += gains[best]
        picked.append(best)
        left[each[best]] *= 0.5
    return picked
