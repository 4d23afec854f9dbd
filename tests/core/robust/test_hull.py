"""Convex hulls of surfaces: a box by hand, and shapes that have none."""

from __future__ import annotations

import pytest
import torch

from regnf_core.robust.model import Hull

CORNERS = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3) * torch.tensor([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("point", "margin", "within"),
    [
        ([0.5, 1.0, 1.5], 0.0, True),
        ([0.5, 1.0, 1.5], 0.49, True),
        ([0.5, 1.0, 1.5], 0.51, False),  # half a unit from the nearest faces
        ([0.5, 1.0, 2.95], 0.1, False),
        ([1.2, 1.0, 1.5], 0.0, False),
        ([1.2, 1.0, 1.5], -0.3, True),
    ],
)
def test_a_box(point: list[float], margin: float, within: bool) -> None:
    assert bool(Hull.of(CORNERS).contains(torch.tensor(point), margin)) is within


def test_nothing_is_within_a_flat_surface() -> None:
    flat = CORNERS * torch.tensor([1.0, 1.0, 0.0])
    assert not bool(Hull.of(flat).contains(flat.mean(0), -1.0))
