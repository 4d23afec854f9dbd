"""A chair of which one depth image is all that was ever seen is found, and its shadow told from it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.robust.depth_camera import DepthCamera
from benchmarks.robust.one_view_field import OneViewField
from benchmarks.simple_meshes import box, together
from regnf_core.library import register
from tests.core.analytic import chair, chair_pose
from tests.core.robust.shapes import ROBUST, detection, placement_error

PARTS = (
    ((-0.24, -0.25, -0.04), (0.24, 0.25, 0.02)), ((-0.24, 0.19, 0.02), (0.24, 0.25, 0.42)),
    ((-0.24, -0.25, -0.40), (-0.18, -0.19, -0.04)), ((0.18, -0.25, -0.40), (0.24, -0.19, -0.04)),
    ((-0.24, 0.19, -0.40), (-0.18, 0.25, -0.04)), ((0.18, 0.19, -0.40), (0.24, 0.25, -0.04)),
    ((0.20, -0.25, 0.16), (0.30, 0.19, 0.22)), ((0.20, -0.25, 0.02), (0.26, -0.19, 0.16)),
)  # fmt: skip
"""The boxes of tests.core.analytic.chair."""


@pytest.mark.parametrize("position", [(0.9, -0.9, 0.85)])
def test_it_is_found(position: tuple[float, float, float]) -> None:
    placed = together(*(box(low, high) for low, high in PARTS)).transformed(chair_pose().inverse().matrix().numpy())
    room = together(placed, box((-1.0, -1.0, -0.06), (1.0, 1.0, 0.0)), box((-1.0, 0.94, 0.0), (1.0, 1.0, 0.9)))
    camera = DepthCamera(room.vertices.astype(np.float32), room.faces.astype(np.int32), far=4.0)
    image = camera.look(np.array(position), detection().center.numpy(), pixels=200)
    scene = OneViewField(image, torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]).double())
    result = register(scene, chair(), detection(), ROBUST)
    assert result.verdict == "registered"
    assert result.metrics["probability"] > 0.9, "what was hidden does not speak against it"
    assert placement_error(result, chair_pose()) < 0.02
    assert result.metrics["occlusion_boundary_share_scene"] > 0.2
    assert result.metrics["occluded_share_object"] > 0.15
