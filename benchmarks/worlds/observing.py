"""What a walk has seen, as regnf keeps it: told by its images, or by where its cameras stood alone."""

from __future__ import annotations

import numpy as np
import torch

from benchmarks.random_worlds.fusing import Capture
from benchmarks.random_worlds.mesh import Array
from regnf_core.fields.observation import Observation, SdfField
from regnf_core.geometry.pinhole import PinholeCameras
from regnf_core.schema.description import SURFACE
from regnf_core.surface.observing import observe_by_cameras
from regnf_fit.images.observing import observe

_CARVING = 36
"""Images that free space is carved with; measured surface comes from all."""
_VOXELS = 192
_EVALUATIONS = 5_000_000
"""Of the field, for the rays of cameras without images: as many as the import of a field makes."""


def observation_of_walk(taken: Capture, bounds: Array) -> Observation:
    """The observation within bounds (2, 3) of the world, by the estimated poses."""
    every = max(1, len(taken.poses) // _CARVING)
    seen = observe(taken.images(bounds, every), _VOXELS)
    assert seen is not None, "a capture has depths"
    height, width = taken.sensor.size
    row, column = np.indices((height, width)).reshape(2, -1)
    rays = np.stack([column + 0.5, row + 0.5, np.ones(row.shape)], axis=1) @ np.linalg.inv(taken.sensor.intrinsics).T
    for depth, pose in zip(taken.depths, taken.estimated, strict=True):
        read = depth.ravel() > 0.0
        ends = (rays[read] * depth.ravel()[read, None]) @ pose[:3, :3].T + pose[:3, 3]
        cells = ((torch.from_numpy(ends) - seen.low) / seen.voxel).floor().long()
        within = ((cells >= 0) & (cells < torch.tensor(seen.states.shape))).all(-1)
        x, y, z = cells[within].unbind(-1)
        seen.states[x, y, z] = SURFACE
    return seen


def cameras_of_walk(taken: Capture) -> PinholeCameras:
    """Where the walk's cameras are thought to have stood, in the world."""
    (height, width), K, poses = taken.sensor.size, taken.sensor.intrinsics, torch.from_numpy(taken.estimated)
    one = [[K[0, 0] / width, K[1, 1] / height], [K[0, 2] / width, K[1, 2] / height]]
    focal, middle = (torch.tensor(pair, dtype=torch.float64).repeat(len(poses), 1) for pair in one)
    aspect = torch.full((len(poses),), width / height, dtype=torch.float64)
    return PinholeCameras(poses[:, :3, 3], poses[:, :3, :3], focal, middle, aspect)


def observation_of_cameras(field: SdfField, cameras: PinholeCameras) -> Observation:
    """What the cameras have seen of a field that was made of their images, in the same frame."""
    return observe_by_cameras(field, cameras, _EVALUATIONS)[0]
