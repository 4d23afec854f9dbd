"""Point sets, sets of poses and rays."""

from __future__ import annotations

import pytest
import torch

from regnf_core.geometry.box import ray_box_interval
from regnf_core.geometry.metrics import NearestNeighbors, diameter, displacement, distinct, gaps
from regnf_core.geometry.sim3 import Sim3

# Neighbors, spacing and size of point sets, against all pairs.


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


# The best distinct poses, against the definition.


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


# Rays and boxes: against the definition, for rays along the axes, within faces and beside the box.

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
