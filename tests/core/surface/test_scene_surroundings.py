"""The scene round the detection: on the surface, outside the box, within the bounds."""

from __future__ import annotations

import torch

from regnf_core.geometry.box import OrientedBox
from regnf_core.surface.result_clouds import sample_surroundings
from tests.core.analytic import AnalyticField, sphere

FLOOR_AND_BALL = AnalyticField(
    lambda p: torch.minimum(p[:, 2], (p - torch.tensor([0.0, 0.0, 0.5], dtype=p.dtype)).norm(dim=-1) - 0.2),
    [[-1.0, -1.0, -0.5], [1.0, 1.0, 1.0]],
)
ROUND_THE_BALL = OrientedBox.from_corners([-0.3, -0.3, 0.1], [0.3, 0.3, 0.8])


def test_points_lie_on_the_floor_and_leave_the_box_out() -> None:
    cloud = sample_surroundings(FLOOR_AND_BALL, ROUND_THE_BALL, 2000, torch.Generator().manual_seed(0))
    assert len(cloud.points) > 1500
    assert not ROUND_THE_BALL.contains(cloud.points).any()
    assert cloud.points[:, 2].abs().max() < 0.01
    torch.testing.assert_close(cloud.normals[:, 2], torch.ones(len(cloud.points)).to(cloud.normals), atol=1e-4, rtol=0)
    assert cloud.points[:, :2].abs().max() <= 1.0


def test_every_quarter_of_the_floor_is_covered() -> None:
    points = sample_surroundings(FLOOR_AND_BALL, ROUND_THE_BALL, 2000, torch.Generator().manual_seed(1)).points
    quarters = (points[:, 0] > 0).long() * 2 + (points[:, 1] > 0).long()
    assert torch.bincount(quarters, minlength=4).min() > 0.15 * len(points)


def test_a_scene_without_a_surface_has_no_surroundings() -> None:
    empty = sphere(0.5, (5.0, 5.0, 5.0))
    assert len(sample_surroundings(empty, ROUND_THE_BALL, 500, torch.Generator().manual_seed(0)).points) == 0
