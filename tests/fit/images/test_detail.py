"""Where surface is not flat, on surfaces whose shape is known."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.geometry.box import OrientedBox
from regnf_fit.images.preparation import in_boxes, uneven

SIZE = 5.0  # cells of 10 cm


def plane(count: int, generator: torch.Generator) -> Tensor:
    """Points of a slanting plane, 2 m wide."""
    uv = 2.0 * torch.rand(count, 2, generator=generator) - 1.0
    return torch.stack([uv[:, 0], uv[:, 1], 0.3 * uv[:, 0] + 0.2 * uv[:, 1] + 0.01], 1)


def test_planes_are_flat_and_small_balls_are_not() -> None:
    generator = torch.Generator().manual_seed(0)
    floor = plane(40_000, generator)
    ball = 0.045 * torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator), dim=1)
    found = uneven(torch.cat([floor, ball + torch.tensor([0.55, 0.55, 1.05])]), torch.zeros(42_000), SIZE)
    assert not found[:40_000].any()
    assert found[40_000:].float().mean() > 0.9


def test_noise_that_is_known_is_no_detail() -> None:
    generator = torch.Generator().manual_seed(1)
    noise = 0.02 * torch.randn(40_000, generator=generator)
    points = plane(40_000, generator)
    points[:, 2] += noise
    assert uneven(points, torch.zeros(40_000), SIZE).float().mean() > 0.9
    assert uneven(points, torch.full((40_000,), 0.02), SIZE).float().mean() < 0.05


def test_no_points_and_lone_points_have_no_detail() -> None:
    assert uneven(torch.zeros(0, 3), torch.zeros(0), SIZE).shape == (0,)
    assert not uneven(torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]), torch.zeros(2), SIZE).any()


def test_boxes_are_a_little_grown() -> None:
    box = OrientedBox(torch.zeros(3).double(), torch.ones(3).double(), torch.eye(3).double())
    points = torch.tensor([[0.0, 0.0, 0.0], [0.54, 0.0, 0.0], [0.7, 0.0, 0.0]])
    assert in_boxes([box], points).tolist() == [True, True, False]
    assert not in_boxes([], points).any()
