"""The errors against a truth, on cases small enough to work out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from regnf_core.geometry.box import ray_box_interval
from regnf_core.geometry.metrics import (
    NearestNeighbors,
    add_s,
    diameter,
    displacement,
    distinct,
    errors_against_truth,
    gaps,
    paper_errors,
    rotation_error,
)
from regnf_core.geometry.sim3 import Sim3

SQUARE = torch.tensor([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]], dtype=torch.float64)


def turn_z(angle: float, scale: float = 1.0, translation: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Sim3:
    return Sim3.from_quaternion(scale, [0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)], translation)


def test_the_papers_three_by_hand() -> None:
    truth = turn_z(0.1, 1.25, (0.0, 0.0, 0.0))
    estimate = turn_z(0.4, 1.20, (0.3, 0.0, 0.4))
    found = paper_errors(estimate, truth)
    assert found["translation_rmse"] == pytest.approx(math.sqrt(0.25 / 3))
    assert found["euler_rmse_rad"] == pytest.approx(0.3 / math.sqrt(3))
    assert found["scale_error"] == pytest.approx(0.05)
    wrapped = paper_errors(turn_z(math.pi - 0.1), turn_z(-math.pi + 0.1))  # at a full turn
    assert wrapped["euler_rmse_rad"] == pytest.approx(0.2 / math.sqrt(3))


def test_rotation_error_is_the_angle_between() -> None:
    quarter_about_x = Sim3.from_quaternion(2.0, [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], [1.0, 2.0, 3.0])
    assert rotation_error(quarter_about_x, Sim3.identity()) == pytest.approx(math.pi / 2)
    assert rotation_error(turn_z(3.0), turn_z(-3.0)) == pytest.approx(2 * math.pi - 6.0)


def test_mssd_by_hand_in_object_units() -> None:
    # Half a turn carries each corner of the square to the opposite one, a diagonal (2 sqrt 2) away.
    assert errors_against_truth(turn_z(math.pi), Sim3.identity(), SQUARE)["mssd"] == pytest.approx(2 * math.sqrt(2))
    # A scale too large by a quarter puts the corners, sqrt 2 from the center, at 1 / 1.25 of that.
    wider = errors_against_truth(turn_z(0, 1.25), Sim3.identity(), SQUARE)
    assert wider["mssd"] == pytest.approx(0.2 * math.sqrt(2))
    # In the scene the object is ten times smaller; a shift of 0.1 scene units is 1 object unit.
    truth = turn_z(0.0, 10.0)
    estimate = truth @ Sim3.from_translation(torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64))
    found = errors_against_truth(estimate, truth, SQUARE, torch.tensor([1.0, 0.0, 0.0]))
    assert (found["mssd"], found["center_error"]) == (pytest.approx(1.0), pytest.approx(0.1))


def test_add_s_forgives_what_mssd_does_not() -> None:
    assert add_s(turn_z(math.pi), Sim3.identity(), SQUARE) == pytest.approx(0.0, abs=1e-12)
    lifted = Sim3.from_translation(torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64))
    assert add_s(lifted, Sim3.identity(), SQUARE) == pytest.approx(0.5)


def test_all_errors_vanish_for_the_truth_and_have_the_promised_names() -> None:
    T = turn_z(0.3, 1.25, (0.1, 0.2, 0.3))
    errors = errors_against_truth(T, T, SQUARE)
    assert {"rotation_error_rad", "center_error_share", "scale_error_share", "mssd_share"} <= set(errors)
    assert all(value == pytest.approx(0.0, abs=1e-7) for value in errors.values())


def test_shares_are_of_the_diameter() -> None:
    shifted = Sim3.from_translation(torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64))
    errors = errors_against_truth(shifted, Sim3.identity(), SQUARE)
    assert errors["center_error_share"] == pytest.approx(0.1 / math.sqrt(8))
    assert errors["mssd_share"] == pytest.approx(0.1 / math.sqrt(8))


@pytest.mark.parametrize("far", [0.0, 7.0, 60.0, 1000.0])
def test_no_error_depends_on_where_the_scenes_origin_is(far: float) -> None:
    """A pose that is off by a little, told by a scene whose origin lies elsewhere. The paper's translation error is
    the counter-example."""
    truth, step = turn_z(0.3, 1.25, (0.1, 0.2, 0.3)), torch.tensor([0.01, 0.0, 0.02, 0.01, 0.0, 0.0, 0.003]).double()
    estimate = truth.perturb(step)
    move = Sim3.from_translation(torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64) * far)
    here, there = (
        errors_against_truth(estimate, truth, SQUARE),
        errors_against_truth(estimate @ move, truth @ move, SQUARE),
    )
    assert there == pytest.approx(here, rel=1e-6, abs=1e-7)
    assert (paper_errors(estimate @ move, truth @ move)["translation_rmse"] > 0.06) == (far > 1.0)


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        (SQUARE, math.sqrt(8)),  # flat: no hull in space
        (torch.cat([SQUARE, SQUARE + torch.tensor([0.0, 0.0, 1.0])]), 3.0),
        (torch.zeros(1, 3), 0.0),
        (torch.tensor([[0.0, 0, 0], [1, 0, 0], [4, 0, 0]]), 4.0),
    ],
)
def test_diameter(points: Tensor, expected: float) -> None:
    assert diameter(points) == pytest.approx(expected)


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
