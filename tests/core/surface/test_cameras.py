"""Where cameras stand, and what they see."""

from __future__ import annotations

import pytest
import torch

from regnf_core.geometry.box import OrientedBox
from regnf_core.options import Axis
from regnf_core.surface.sphere_tracing import camera_positions, cast_rays


def test_cameras_stand_on_the_upper_half_sphere_and_apart() -> None:
    center = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    axes: list[tuple[Axis, int]] = [("x", 0), ("y", 1), ("z", 2)]
    for axis, number in axes:
        offsets = camera_positions(center, 0.9, 5, axis) - center
        torch.testing.assert_close(offsets.norm(dim=1), torch.full((5,), 0.9, dtype=torch.float64))
        torch.testing.assert_close(
            offsets[:, number], 0.9 * torch.tensor([0.9, 0.7, 0.5, 0.3, 0.1], dtype=torch.float64)
        )
        angles = torch.pdist(offsets / 0.9)
        assert float(angles.min()) > 0.6  # chord of about 35 degrees


def test_every_corner_of_the_box_is_in_view_and_the_view_is_no_wider() -> None:
    position = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64)
    corners = OrientedBox.from_corners([-0.5, -0.2, -1.0], [0.5, 0.2, 1.0]).corners()
    (rays,) = cast_rays(position, torch.zeros(3, dtype=torch.float64), corners, 512, 8)
    assert rays.directions.shape == (64 * 64, 3)
    torch.testing.assert_close(rays.directions.norm(dim=1), torch.ones(64 * 64))
    # The nearest corner is 0.5 and 0.2 off the axis at depth 1; pixel centers reach 63/64 of the way.
    slopes = (rays.directions[:, :2] / -rays.directions[:, 2:]).abs().amax(0)
    torch.testing.assert_close(slopes, torch.full((2,), 0.5 * 63 / 64), rtol=1e-4, atol=0)


@pytest.mark.parametrize("most", [1, 7, 100, 450, 10**6])
def test_rays_in_parts_are_the_same_rays_in_the_same_order(most: int) -> None:
    target = torch.zeros(3, dtype=torch.float64)
    positions = camera_positions(target, 2.0, 3, "z", 0.3)
    corners = OrientedBox.from_corners([-0.5, -0.2, -1.0], [0.5, 0.2, 1.0]).corners()
    (whole,) = cast_rays(positions, target, corners, 96, 8)
    parts = list(cast_rays(positions, target, corners, 96, 8, most))
    assert max(len(part.origins) for part in parts) <= most
    assert torch.equal(torch.cat([part.origins for part in parts]), whole.origins)
    assert torch.equal(torch.cat([part.directions for part in parts]), whole.directions)
