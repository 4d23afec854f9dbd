"""Rays and boxes: against the definition, for rays along the axes, within faces and beside the box."""

from __future__ import annotations

import pytest
import torch

from regnf_core.geometry.box import ray_box_interval

LOW, HIGH = torch.tensor([-1.0, -2.0, 0.0]).double(), torch.tensor([1.0, 2.0, 4.0]).double()


def interval(origin: list[float], direction: list[float]) -> tuple[float, float]:
    entry, leave = ray_box_interval(torch.tensor([origin]).double(), torch.tensor([direction]).double(), LOW, HIGH)
    return float(entry), float(leave)


def test_points_between_entry_and_exit_are_those_inside() -> None:
    generator = torch.Generator().manual_seed(0)
    origins = 6.0 * torch.rand(300, 3, generator=generator).double() - 3.0
    directions = torch.randn(300, 3, generator=generator).double()
    entry, leave = ray_box_interval(origins, directions, LOW, HIGH)
    steps = torch.linspace(0.0, 8.0, 997).double()
    points = origins[:, None] + steps[:, None] * directions[:, None]
    inside = ((points >= LOW) & (points <= HIGH)).all(-1)
    assert torch.equal((steps >= entry[:, None]) & (steps <= leave[:, None]), inside)
    assert inside.any(1).sum() > 50
    assert (leave <= entry).sum() > 100


def test_along_an_axis_by_hand() -> None:
    assert interval([-3.0, 0.0, 1.0], [2.0, 0.0, 0.0]) == (1.0, 2.0)
    assert interval([0.0, 0.0, 1.0], [0.0, 0.0, -1.0]) == (0.0, 1.0)
    entry, leave = interval([-3.0, 5.0, 1.0], [1.0, 0.0, 0.0])
    assert leave <= entry


@pytest.mark.parametrize("x", [-1.0, 1.0])
def test_a_ray_within_a_face_is_inside(x: float) -> None:
    assert interval([x, 0.0, -1.0], [0.0, 0.0, 1.0]) == (1.0, 5.0)
