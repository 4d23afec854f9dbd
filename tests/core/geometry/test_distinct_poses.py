"""The best distinct poses, against the definition."""

from __future__ import annotations

import pytest
import torch

from regnf_core.geometry.metrics import displacement, distinct
from regnf_core.geometry.sim3 import Sim3


def poses(count: int) -> Sim3:
    draw = torch.Generator().manual_seed(4)
    return Sim3.exp(0.1 * torch.randn(count, 7, generator=draw, dtype=torch.float64))


@pytest.mark.parametrize(("apart", "limit"), [(0.4, 100), (0.4, 3), (0.6, 100), (0.0, 100)])
def test_keeps_the_best_that_are_apart(apart: float, limit: int) -> None:
    T, points = poses(60), torch.randn(5, 3, generator=torch.Generator().manual_seed(1))
    scores = torch.rand(60, generator=torch.Generator().manual_seed(2))
    expected: list[int] = []
    for number in scores.argsort().tolist():
        if all(float(displacement(T[number : number + 1], T[other], points)) >= apart for other in expected):
            expected.append(number)
    found = distinct(T, scores, points, apart, limit).tolist()
    assert found == expected[:limit]
    assert 1 < len(expected) < 60 or apart == 0.0


def test_no_poses_give_none() -> None:
    assert distinct(poses(3)[:0], torch.zeros(0), torch.ones(2, 3), 0.1, 5).tolist() == []
