"""Surface points: tracing, projection, more of them, residuals, what is around."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from regnf_core.fields.observation import CountingField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import Axis, SamplingOptions
from regnf_core.paper.sampling import sample_scene
from regnf_core.surface.result_clouds import (
    newton_step,
    object_residuals,
    project_to_surface,
    sample_surroundings,
    scene_residuals,
    upsample,
)
from regnf_core.surface.sphere_tracing import Rays, camera_positions, cast_rays, first_hits
from tests.core.analytic import AnalyticField, boxes, sphere

# Sphere tracing: first crossings from free space into matter, against shapes whose surface is known.


def trace(field: AnalyticField, origins: list[list[float]], directions: list[list[float]]) -> tuple[Tensor, Tensor]:
    rays = Rays(torch.tensor(origins), torch.tensor(directions))
    count = len(origins)
    hits = first_hits(field, rays, torch.zeros(count), torch.full((count,), 3.0), 1e-3, 1e-4)
    order = hits.rays.argsort()
    return hits.points[order], hits.rays[order]


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


# Newton steps to the surface: exact for distances, bounded where the gradient is short.


def test_one_step_reaches_the_surface_of_an_exact_distance() -> None:
    ball = sphere(0.3)
    points = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    found = project_to_surface(ball.signed_distance_and_gradient, 0.5 * points, 1)
    torch.testing.assert_close(found.points, 0.3 * points, atol=1e-6, rtol=0)
    assert found.distance.abs().max() < 1e-6
    torch.testing.assert_close(found.gradient, points, atol=1e-5, rtol=0)


def test_each_step_and_the_end_evaluate_once() -> None:
    counting, once = CountingField(sphere(0.3)), CountingField(sphere(0.3))
    project_to_surface(counting.signed_distance_and_gradient, torch.full((7, 3), 0.3), 3)
    once.signed_distance_and_gradient(torch.full((7, 3), 0.3))
    assert counting.evaluations == 4 * once.evaluations


@pytest.mark.parametrize(("slope", "floor", "moved"), [(0.5, 0.5, 2.0), (0.1, 0.5, 0.4), (0.1, 0.01, 10.0)])
def test_a_short_gradient_counts_as_min_slope(slope: float, floor: float, moved: float) -> None:
    gradient = torch.tensor([[slope, 0.0, 0.0]])
    step = newton_step(torch.ones(1), gradient, floor)
    torch.testing.assert_close(step, torch.tensor([[moved, 0.0, 0.0]]))


def test_no_gradient_moves_nothing() -> None:
    def flat(points: Tensor) -> tuple[Tensor, Tensor]:
        return torch.ones(len(points)), torch.zeros_like(points)

    start = torch.rand(4, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(project_to_surface(flat, start, 2).points, start)


# New points between old ones lie on the surface and where they may.

OPTIONS = SamplingOptions(pixel_stride=16)
BALL_BOX = OrientedBox.from_corners([-0.3, -0.3, -0.3], [0.3, 0.3, 0.3])


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


# Residuals between two fields: with the scale, and with the sign that tells missing matter from too much.


def test_residuals_keep_the_scale() -> None:
    # The same ball in units twice as small: exact agreement everywhere, on the surface and off it.
    T = Sim3.from_quaternion(2.0, [0, 0, 0, 1], [0.1, 0, 0])
    small, large = sphere(0.2), sphere(0.4, (0.1, 0, 0))
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    assert float(scene_residuals(small, large, points, T).abs().max()) < 1e-6
    assert float(object_residuals(small, large, points, T).abs().max()) < 1e-6


def test_the_sign_tells_missing_matter_from_too_much() -> None:
    on_large = torch.tensor([[0.0, 0.4, 0.0]])
    assert float(object_residuals(sphere(0.3), sphere(0.4), on_large, Sim3.identity())) == pytest.approx(0.1, abs=1e-6)
    on_small = torch.tensor([[0.0, 0.3, 0.0]])
    assert float(object_residuals(sphere(0.4), sphere(0.3), on_small, Sim3.identity())) == pytest.approx(-0.1, abs=1e-6)


# The scene round the detection: on the surface, outside the box, within the bounds.

FLOOR_AND_BALL = AnalyticField(
    lambda p: torch.minimum(p[:, 2], (p - torch.tensor([0.0, 0.0, 0.5], dtype=p.dtype)).norm(dim=-1) - 0.2),
    [[-1.0, -1.0, -0.5], [1.0, 1.0, 1.0]],
)
ROUND_THE_BALL = OrientedBox.from_corners([-0.3, -0.3, 0.1], [0.3, 0.3, 0.8])


def test_points_lie_on_the_floor_and_leave_the_box_out() -> None:
    cloud = sample_surroundings(FLOOR_AND_BALL, ROUND_THE_BALL, 2000, torch.Generator().manual_seed(0))
    assert len(cloud.points) > 1500
    assert not ROUND_THE_BALL.contains(cloud.points).any()
    assert cloud.points[:, 2].abs().max() < 0.01
    torch.testing.assert_close(cloud.normals[:, 2], torch.ones(len(cloud.points)).to(cloud.normals), atol=1e-4, rtol=0)
    assert cloud.points[:, :2].abs().max() <= 1.0
    quarters = (cloud.points[:, 0] > 0).long() * 2 + (cloud.points[:, 1] > 0).long()
    assert torch.bincount(quarters, minlength=4).min() > 0.15 * len(cloud.points)


def test_a_scene_without_a_surface_has_no_surroundings() -> None:
    empty = sphere(0.5, (5.0, 5.0, 5.0))
    assert len(sample_surroundings(empty, ROUND_THE_BALL, 500, torch.Generator().manual_seed(0)).points) == 0


# Where cameras stand, and what they see.


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
    (rays,) = cast_rays(position, torch.zeros(3, dtype=torch.float64), corners, 512, 8)
    assert rays.directions.shape == (64 * 64, 3)
    torch.testing.assert_close(rays.directions.norm(dim=1), torch.ones(64 * 64))
    # The nearest corner is 0.5 and 0.2 off the axis at depth 1; pixel centers reach 63/64 of the way.
    slopes = (rays.directions[:, :2] / -rays.directions[:, 2:]).abs().amax(0)
    torch.testing.assert_close(slopes, torch.full((2,), 0.5 * 63 / 64), rtol=1e-4, atol=0)


@pytest.mark.parametrize("most", [1, 7, 100, 450, 10**6])
def test_rays_in_parts_are_the_same_rays_in_the_same_order(most: int) -> None:
    target = torch.zeros(3, dtype=torch.float64)
    positions = camera_positions(target, 2.0, 3, "z", 0.3)
    corners = OrientedBox.from_corners([-0.5, -0.2, -1.0], [0.5, 0.2, 1.0]).corners()
    (whole,) = cast_rays(positions, target, corners, 96, 8)
    parts = list(cast_rays(positions, target, corners, 96, 8, most))
    assert max(len(part.origins) for part in parts) <= most
    assert torch.equal(torch.cat([part.origins for part in parts]), whole.origins)
    assert torch.equal(torch.cat([part.directions for part in parts]), whole.directions)
