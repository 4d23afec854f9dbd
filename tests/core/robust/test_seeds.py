"""Seeds of the search: the same poses, however many are made at once."""

from __future__ import annotations

import pytest
import torch

from regnf_core.robust.search import bounds
from regnf_core.robust.search.bounds import super_fibonacci


def poses(points: torch.Tensor) -> torch.Tensor:
    scales = torch.tensor([0.85, 1.0, 1.18])
    axes, size = torch.eye(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    return bounds.seed_poses(points, 2.0 * points, axes, size, super_fibonacci(301), scales).matrix()


def test_turned_in_parts_objects_have_the_same_extents(monkeypatch: pytest.MonkeyPatch) -> None:
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    whole = poses(points)
    monkeypatch.setattr(bounds, "_POINTS_AT_ONCE", 10_000)
    assert torch.equal(poses(points), whole)
    monkeypatch.setattr(bounds, "_POINTS_AT_ONCE", 1)
    assert poses(points).shape == whole.shape
