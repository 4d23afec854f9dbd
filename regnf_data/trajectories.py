"""Where cameras stand and what they look at: orbits of an object, walks through a room, one bad view. Meters, z up."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError
from regnf_data.mesh_scene import MeshScene
from regnf_data.walking import WalkingGround

Array = NDArray[np.float64]

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
    positions = []
    for ring, (count, elevation) in enumerate(zip(counts, _elevations(center, distance, floor), strict=True)):
        azimuth = 2.0 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / max(count, 1)
        positions.append(_on_sphere(center, distance, azimuth, np.full(count, elevation)))
    return _towards(np.concatenate(positions), center)


def pass_by(bounds: Array, frames: int, half_view: float, floor: float) -> Array:
    """(frames, 4, 4): an arc of 130 degrees about the direction +x of bounds (2, 3), at one height."""
    center = bounds.mean(axis=0)
    distance = framing_distance(bounds, half_view)
    half = math.radians(_SHORT_ARC_DEG) / 2.0
    elevation = _elevations(center, distance, floor)[1]
    return _towards(_on_sphere(center, distance, np.linspace(-half, half, frames), np.full(frames, elevation)), center)


def long_walk(ground: WalkingGround, boxes: Sequence[Array], frames: int) -> Array:
    """(frames, 4, 4): two laps at two heights, round every box (2, 3) of furniture in turn, looking at it.

    From one to the next the camera goes by the shortest way through free space.
    """
    laps = _shared_out(frames, (0.5, 0.5))
    poses = []
    for count, height in zip(laps, WALK_HEIGHTS_M, strict=True):
        path, watched = _tour(ground, boxes)
        poses.append(_walked(path, watched, count, height))
    return np.concatenate(poses)


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


def _on_sphere(center: Array, distance: float, azimuth: Array, elevation: Array) -> Array:
    level = np.cos(elevation)
    unit = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    around: Array = center + distance * unit
    return around


def _towards(positions: Array, center: Array) -> Array:
    return look_at(positions, np.broadcast_to(center, positions.shape))


def _shared_out(count: int, shares: Sequence[float]) -> list[int]:
    """Whole numbers that sum to ``count``, close to the shares of it."""
    ends = np.round(np.cumsum(shares) / sum(shares) * count).astype(int)
    return [int(count) for count in np.diff(ends, prepend=0)]


def check_free(scene: MeshScene, poses: Array) -> None:
    """Raises DatasetError (DATASET_NO_FREE_PATH) where a camera would be in matter, or touch it."""
    if float(scene.signed_distance(poses[:, :3, 3]).min()) < CLEARANCE_M / 2.0:
        raise DatasetError("a camera would stand in matter", reason="DATASET_NO_FREE_PATH")
