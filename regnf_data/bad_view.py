"""One view of one thing, a poor one, chosen by rule."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError
from regnf_core.fields.composite import SurfaceSource
from regnf_data.mesh_scene import MeshScene, Thing
from regnf_data.rendering import Size
from regnf_data.trajectories import CLEARANCE_M, framing_distance, look_at

Array = NDArray[np.float64]

_AZIMUTHS = 16
_HEIGHTS_M = (0.35, 1.3)
_NEARER = (1.0, 0.8, 0.65)
_SAMPLES = 2000
_MIN_SHOWN = 0.8
_MIN_SEEN = 0.02


def bad_view(scene: MeshScene, thing: Thing, size: Size, intrinsics: Array, floor: float) -> Array:
    """(4, 4): of all views that show the thing, the one that sees the least of its surface.

    Candidates stand in free space at 16 azimuths, 35 cm and 1.3 m above the floor, where the thing just fills the
    picture; nearer only if none of these will do. A view counts as showing the thing when others hide at most a fifth
    of what it would show of it alone. So the camera ends up behind a back or low at a side, the first of equals.
    Raises DatasetError (DATASET_NO_VIEW).
    """
    solid = thing.solid
    assert isinstance(solid, SurfaceSource)
    samples = solid.sample_surface(_SAMPLES, np.random.default_rng(0))
    alone = MeshScene([thing])
    bounds = solid.bounds.numpy()
    for nearer in _NEARER:
        best, least = None, np.inf
        distance = nearer * framing_distance(bounds, half_view(size, intrinsics))
        for pose in _candidates(scene, bounds.mean(axis=0), distance, floor):
            seen = seen_points(scene, pose, size, intrinsics, samples).mean()
            shown = seen_points(alone, pose, size, intrinsics, samples).mean()
            if seen >= max(_MIN_SHOWN * shown, _MIN_SEEN) and seen < least:
                best, least = pose, seen
        if best is not None:
            return best
    raise DatasetError(f"{thing.name} is hidden from everywhere", reason="DATASET_NO_VIEW")


def seen_points(scene: MeshScene, pose: Array, size: Size, intrinsics: Array, points: Array) -> NDArray[np.bool_]:
    """(N,): which surface points (N, 3) a camera at ``pose`` (4, 4) sees: in the picture, and nothing before them."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    ahead = local[:, 2] > 0.0
    u, v, _ = intrinsics @ (local / np.where(ahead, local[:, 2], 1.0)[:, None]).T
    inside: NDArray[np.bool_] = ahead & (u >= 0.0) & (u < size[1]) & (v >= 0.0) & (v < size[0])
    inside[inside] = scene.sees(pose[:3, 3], points[inside])
    return inside


def half_view(size: Size, intrinsics: Array) -> float:
    """Half the narrower angle of view, radians."""
    return float(min(np.arctan(size[1] / 2.0 / intrinsics[0, 0]), np.arctan(size[0] / 2.0 / intrinsics[1, 1])))


def _candidates(scene: MeshScene, center: Array, distance: float, floor: float) -> Iterator[Array]:
    low, high = scene.bounds
    alone = len(scene.things) == 1
    for height in _HEIGHTS_M:
        rise = floor + height - center[2]
        level = distance**2 - rise**2
        if level <= 0.0:
            continue
        angles = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
        ring = np.sqrt(level) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        positions = center + np.concatenate([ring, np.full((_AZIMUTHS, 1), rise)], axis=1)
        free = scene.signed_distance(positions) >= CLEARANCE_M
        # The far side of a wall is free too, but outside of the room.
        inside = alone | ((positions > low) & (positions < high))[:, :2].all(axis=1)
        yield from look_at(positions[free & inside], np.tile(center, (int((free & inside).sum()), 1)))
