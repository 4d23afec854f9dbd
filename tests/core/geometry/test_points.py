"""Neighbors, spacing and size of point sets, against all pairs."""

from __future__ import annotations

import pytest
import torch

from regnf_core.geometry.metrics import NearestNeighbors, diameter, gaps


def cloud(count: int, seed: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))


def test_nearest_points_are_those_of_all_pairs() -> None:
    points, queries = cloud(200, 0), cloud(50, 1)
    all_pairs = torch.cdist(queries.double(), points.double())
    distance, index = NearestNeighbors(points).query(queries)
    assert distance.dtype == queries.dtype
    assert torch.equal(index, all_pairs.argmin(1))
    torch.testing.assert_close(distance, all_pairs.amin(1).float())
    several, indices = NearestNeighbors(points).query_several(queries, 5)
    assert torch.equal(indices, all_pairs.argsort(1)[:, :5])
    assert torch.equal(several[:, 0], distance)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_small_clouds_give_as_many_neighbors_as_they_have(count: int) -> None:
    points = cloud(count, 2)
    assert NearestNeighbors(points).query_several(points, 9)[1].shape == (count, count)
    assert gaps(points).shape == (count,)


def test_gaps_of_a_line_by_hand() -> None:
    line = torch.zeros(6, 3)
    line[:, 0] = torch.arange(6.0)
    assert gaps(line).tolist() == [3.0, 2.0, 2.0, 2.0, 2.0, 3.0]


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_diameter_is_the_largest_of_all_distances(scale: float) -> None:
    points = scale * cloud(300, 3)
    assert diameter(points) == pytest.approx(float(torch.pdist(points.double()).max()), rel=1e-6)
    flat = points * torch.tensor([1.0, 1.0, 0.0])
    assert diameter(flat) == pytest.approx(float(torch.pdist(flat.double()).max()), rel=0.02)
    assert diameter(points[:1]) == 0.0
