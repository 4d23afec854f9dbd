"""Distance grids against the samples they are made of."""

from __future__ import annotations

import torch

from regnf_core.robust.constants import SEARCH
from regnf_core.robust.search.distance_grid import DistanceGrid, nearest_sample_distance


def sphere(count: int = 1500) -> torch.Tensor:
    draw = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return draw / draw.norm(dim=1, keepdim=True)


def made() -> tuple[torch.Tensor, DistanceGrid]:
    normals = sphere()
    return normals, DistanceGrid.of(0.5 * normals, normals, 0.05, SEARCH.grid_margin)


def test_holds_the_samples_distance_at_the_cells_centers() -> None:
    normals, grid = made()
    numbers = torch.randint(SEARCH.grid_cells, (200, 3), generator=torch.Generator().manual_seed(1))
    centers = grid.low[:, 0] + (numbers + 0.5) * grid.edge[:, 0]
    value, gradient = grid.value_and_gradient(centers)
    expected, slope = nearest_sample_distance(0.5 * normals, normals, 0.05, centers)
    torch.testing.assert_close(value, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(gradient, slope, rtol=0, atol=1e-6)


def test_goes_on_from_the_center_along_the_gradient() -> None:
    _, grid = made()
    center = grid.low[:, 0] + 10.5 * grid.edge[:, 0]
    value, gradient = grid.value_and_gradient(center[None])
    step = 0.4 * grid.edge[:, 0] * torch.tensor([1.0, -1.0, 0.5])
    moved, same = grid.value_and_gradient((center + step)[None])
    torch.testing.assert_close(same, gradient)
    torch.testing.assert_close(moved, value + (gradient[0] @ step)[None], rtol=0, atol=1e-6)


def test_adds_the_distance_to_the_grid_beyond_it() -> None:
    _, grid = made()
    border = torch.stack([grid.high[:, 0], torch.tensor([0.0, 0.0, float(grid.low[2, 0])])])
    outside = border + torch.tensor([[0.3, 0.4, 0.0], [0.0, 0.0, -2.0]])
    value, gradient = grid.value_and_gradient(outside)
    at_border, _ = grid.value_and_gradient(border)
    torch.testing.assert_close(value - at_border, torch.tensor([0.5, 2.0]))
    torch.testing.assert_close(gradient, torch.tensor([[0.6, 0.8, 0.0], [0.0, 0.0, -1.0]]))
