"""Cameras, sphere tracing and the surface points they give, against shapes whose surface is known."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from regnf_core.errors import InvalidDetectionError, InvalidInputError, NoSurfaceError
from regnf_core.fields.counting import CountingField
from regnf_core.geometry.box import OrientedBox
from regnf_core.options import Axis, SamplingOptions
from regnf_core.paper.sampling import sample_object, sample_scene
from regnf_core.surface.cameras import Rays, camera_positions, cast_rays
from regnf_core.surface.sphere_tracing import first_hits
from regnf_core.surface.surface_bounds import surface_bounds
from regnf_core.surface.upsampling import upsample
from tests.core.analytic import AnalyticField, boxes, chair, chair_box, chair_pose, room, sphere

OPTIONS = SamplingOptions(pixel_stride=16)
BALL_BOX = OrientedBox.from_corners([-0.3, -0.3, -0.3], [0.3, 0.3, 0.3])


def trace(field: AnalyticField, origins: list[list[float]], directions: list[list[float]]) -> tuple[Tensor, Tensor]:
    rays = Rays(torch.tensor(origins), torch.tensor(directions))
    count = len(origins)
    hits = first_hits(field, rays, torch.zeros(count), torch.full((count,), 3.0), 1e-3, 1e-4)
    order = hits.rays.argsort()
    return hits.points[order], hits.rays[order]


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
    rays = cast_rays(position, torch.zeros(3, dtype=torch.float64), corners, 512, 8)
    assert rays.directions.shape == (64 * 64, 3)
    torch.testing.assert_close(rays.directions.norm(dim=1), torch.ones(64 * 64))
    # The nearest corner is 0.5 and 0.2 off the axis at depth 1; pixel centers reach 63/64 of the way.
    slopes = (rays.directions[:, :2] / -rays.directions[:, 2:]).abs().amax(0)
    torch.testing.assert_close(slopes, torch.full((2,), 0.5 * 63 / 64), rtol=1e-4, atol=0)


def test_first_hits_by_hand() -> None:
    ball = sphere(0.5)
    points, rays = trace(
        ball,
        [[2.0, 0, 0], [0, 2.0, 0.3], [0, 2.0, 0.6], [0.1, 0, 0]],
        [[-1.0, 0, 0], [0, -1.0, 0], [0, -1.0, 0], [1.0, 0, 0]],
    )
    # The third ray misses; the fourth starts inside matter and must not come out on the far side.
    assert rays.tolist() == [0, 1]
    torch.testing.assert_close(points, torch.tensor([[0.5, 0, 0], [0, 0.4, 0.3]]), rtol=0, atol=1e-5)


def test_the_visible_side_of_two_sheets_is_returned() -> None:
    sheets = boxes([([-1, -1, 0.3], [1, 1, 0.32]), ([-1, -1, -0.1], [1, 1, 0.0])])
    points, _ = trace(sheets, [[0.1, 0.2, 0.9]], [[0, 0, -1.0]])
    torch.testing.assert_close(points, torch.tensor([[0.1, 0.2, 0.32]]), rtol=0, atol=1e-4)


def test_a_field_that_is_no_distance_still_gives_its_zero() -> None:
    def warped(points: Tensor) -> Tensor:
        distance = points.norm(dim=-1) - 0.5
        return distance * (1.3 + 0.4 * (9 * points).sin().prod(-1))  # slopes of 0.9 to 1.7

    generator = torch.Generator().manual_seed(0)
    origins = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=1) * 1.5
    aims = torch.nn.functional.normalize(0.2 * torch.randn(200, 3, generator=generator) - origins, dim=1)
    field = AnalyticField(warped, [[-2, -2, -2], [2, 2, 2]])
    points, rays = trace(field, origins.tolist(), aims.tolist())
    assert len(rays) > 100
    assert float((points.norm(dim=1) - 0.5).abs().max()) < 2e-4
    towards = (points - origins[rays]).norm(dim=1)
    nearest = (origins[rays].norm(dim=1) - 0.5).min()
    assert float(towards.min()) >= float(nearest) - 1e-4
    assert bool((points * aims[rays]).sum(-1).lt(0.05).all())  # on the side that faces the camera


def test_rays_at_rest_are_not_evaluated_again() -> None:
    counted = CountingField(sphere(0.5))
    origins = torch.tensor([[0.51, 0.0, 0.0]]).repeat(1000, 1)
    origins[0] = torch.tensor([3.0, 0.0, 0.0])
    rays = Rays(origins, torch.tensor([[-1.0, 0.0, 0.0]]).expand(1000, 3))
    first_hits(counted, rays, torch.zeros(1000), torch.full((1000,), 4.0), 1e-3, 1e-4)
    assert counted.evaluations < 1000 * 30


def test_points_of_a_ball_lie_on_it_with_outward_normals() -> None:
    samples = sample_scene(sphere(0.25), BALL_BOX, OPTIONS)
    torch.testing.assert_close(samples.points.norm(dim=1), torch.full((len(samples.points),), 0.25), rtol=0, atol=1e-3)
    torch.testing.assert_close(samples.normals, samples.points / 0.25, rtol=0, atol=0.01)


def test_ground_and_surroundings_are_left_out() -> None:
    T = chair_pose()
    box = chair_box(T)
    samples = sample_scene(room(T), box, OPTIONS)
    assert box.contains(samples.points, 0.05).all()
    assert float(samples.points[:, 2].min()) >= 0.025 * 0.65
    # What remains is the chair, seen from the object's frame.
    assert float(chair().signed_distance(T.apply(samples.points)).abs().max()) < 1e-3


def test_the_ground_follows_the_up_axis() -> None:
    ball = sphere(0.25)
    axes: list[tuple[Axis, int]] = [("x", 0), ("y", 1), ("z", 2)]
    for axis, number in axes:
        found = sample_scene(ball, BALL_BOX, SamplingOptions(pixel_stride=16, ground_fraction=0.5), up_axis=axis)
        assert float(found.points[:, number].min()) >= 0.0


def test_an_object_smaller_than_its_bounds_is_found_and_filled() -> None:
    small = sphere(0.1, (0.6, -0.5, 0.4), bounds=[[-1, -1, -1], [1, 1, 1]])
    extent = surface_bounds(small)
    torch.testing.assert_close(extent.center, torch.tensor([0.6, -0.5, 0.4], dtype=torch.float64), rtol=0, atol=0.02)
    torch.testing.assert_close(extent.size, torch.full((3,), 0.2, dtype=torch.float64), rtol=0.15, atol=0)
    assert len(sample_object(small, OPTIONS).points) > 1000


def test_cameras_that_would_stand_inside_a_large_object_step_back() -> None:
    assert len(sample_object(sphere(0.95), OPTIONS).points) > 800


def test_other_views_give_other_points() -> None:
    first, second = (sample_object(chair(), OPTIONS, turn).points for turn in (0.0, 0.6))
    assert float(torch.cdist(first, second).amin(1).median()) > 1e-4


def test_subsampling_is_by_the_generator_alone() -> None:
    samples = sample_object(chair(), OPTIONS)
    one, two = (samples.subsample(100, torch.Generator().manual_seed(3)) for _ in range(2))
    assert one.points.shape == (100, 3)
    assert torch.equal(one.points, two.points)
    assert samples.subsample(10**6, torch.Generator()) is samples


def test_upsampled_points_lie_on_the_surface_and_inside() -> None:
    ball = sphere(0.25)
    samples = sample_scene(ball, BALL_BOX, OPTIONS)
    upper = samples.points[:, 2] > 0
    half = samples[upper]
    dense = upsample(ball, half, 3000, torch.Generator().manual_seed(0), lambda points: points[:, 2] > 0)
    assert 2000 < len(dense.points) <= 3000
    assert float((dense.points.norm(dim=1) - 0.25).abs().max()) < 1e-3
    assert bool((dense.points[:, 2] > 0).all())
    torch.testing.assert_close(dense.normals.norm(dim=1), torch.ones(len(dense.normals)))


def reason_of(error: pytest.ExceptionInfo[InvalidInputError] | pytest.ExceptionInfo[NoSurfaceError]) -> str:
    return error.value.reason


def test_a_box_that_misses_the_scene_is_refused() -> None:
    with pytest.raises(InvalidDetectionError) as caught:
        sample_scene(sphere(0.2), OrientedBox.from_corners([2, 2, 2], [3, 3, 3]), OPTIONS)
    assert reason_of(caught) == "DETECTION_OUTSIDE_SCENE"


def test_corners_need_three_coordinates_each() -> None:
    with pytest.raises(InvalidDetectionError) as caught:
        OrientedBox.from_corners([0], [1, 1, 1])
    assert reason_of(caught) == "INVALID_DETECTION"


def test_a_box_round_nothing_is_refused() -> None:
    with pytest.raises(NoSurfaceError) as caught:
        sample_scene(sphere(0.2), OrientedBox.from_corners([0.5, 0.5, 0.5], [0.9, 0.9, 0.9]), OPTIONS)
    assert reason_of(caught) == "NO_SURFACE_IN_DETECTION"


def test_an_object_without_surface_is_refused() -> None:
    with pytest.raises(NoSurfaceError) as caught:
        sample_object(sphere(0.1, (5.0, 0.0, 0.0)), OPTIONS)
    assert reason_of(caught) == "NO_SURFACE_IN_OBJECT"


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_field_that_is_not_finite_is_refused(value: float) -> None:
    broken = AnalyticField(lambda points: points[:, 0] * 0 + value, [[-1, -1, -1], [1, 1, 1]])
    for attempt in (lambda: sample_scene(broken, BALL_BOX, OPTIONS), lambda: sample_object(broken, OPTIONS)):
        with pytest.raises(InvalidInputError) as caught:
            attempt()
        assert reason_of(caught) == "FIELD_NOT_FINITE"
