"""What the images of a walk have seen, as regnf keeps it; from a part of the images where there are many."""

from __future__ import annotations

import numpy as np
import torch

from regnf_core.fields.observation import Observation
from regnf_core.schema.observation_grid import SURFACE
from regnf_data.worlds.capture import Capture
from regnf_data.worlds.mesh import Array
from regnf_fit.images.observing import observe

_CARVING = 36
"""Images that free space is carved with; measured surface comes from all."""
_VOXELS = 192


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
