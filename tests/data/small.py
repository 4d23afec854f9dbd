"""Posed images small enough to write by hand."""

from __future__ import annotations

import numpy as np
import torch

from regnf_core.geometry.box import OrientedBox
from regnf_data.posed_images import Instance, PosedImages


def two_images() -> PosedImages:
    """Two random images of 4 x 6 pixels with everything that a dataset may carry, in numbers that do not end."""
    rng = np.random.default_rng(3)
    turn = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, :3] = turn
    poses[:, :3, 3] = rng.normal(size=(2, 3))
    intrinsics = np.array([[5.1, 0.0, 3.0], [0.0, 5.2, 2.0], [0.0, 0.0, 1.0]]) + np.zeros((2, 1, 1))
    depths = rng.random((2, 4, 6)).astype(np.float32)
    depths[0, 1, 2] = 0.0
    box = OrientedBox(torch.tensor([0.1, 0.2, 0.3]), torch.tensor([0.3, 0.1, 0.7]), torch.tensor(turn), "chair")
    T_object_world = np.eye(4)
    T_object_world[:3, :3] = turn * 1.7
    T_metric_world = np.diag([2.0, 2.0, 2.0, 1.0])
    return PosedImages(
        colors=rng.integers(0, 256, (2, 4, 6, 3), dtype=np.uint8),
        intrinsics=intrinsics,
        T_world_camera=poses,
        bounds=np.array([[-0.7, -0.8, -0.9], [0.1, 0.2, 1.0 / 3.0]]),
        depths=depths,
        masks=rng.random((2, 4, 6)) > 0.5,
        instances=(
            Instance("chair", box, T_object_world, world_pose=np.diag([0.5, 0.5, 0.5, 1.0]), gt_pose=np.eye(4)),
            Instance("table", OrientedBox.from_corners([0.1, 0.2, 0.3], [0.4, 0.6, 1.1], "table")),
        ),
        T_metric_world=T_metric_world,
    )
