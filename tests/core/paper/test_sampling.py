"""Surface points of scene and object as cameras see them, against shapes whose surface is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
import torch

from regnf_core.errors import InvalidInputError, RegnfError
from regnf_core.geometry.box import OrientedBox
from regnf_core.options import Axis, SamplingOptions
from regnf_core.paper.sampling import sample_object, sample_scene
from regnf_core.surface.sphere_tracing import Rays, cast_rays, surface_bounds
from tests.core.analytic import AnalyticField, chair, chair_box, chair_pose, room, sphere

OPTIONS = SamplingOptions(pixel_stride=16)
box = OrientedBox.from_corners
BALL_BOX = box([-0.3, -0.3, -0.3], [0.3, 0.3, 0.3])


def test_points_of_a_ball_lie_on_it_with_outward_normals() -> None:
    samples = sample_scene(sphere(0.25), BALL_BOX, OPTIONS)
    torch.testing.assert_close(samples.points.norm(dim=1), torch.full((len(samples.points),), 0.25), rtol=0, atol=1e-3)
    torch.testing.assert_close(samples.normals, samples.points / 0.25, rtol=0, atol=0.01)


def test_ground_and_surroundings_are_left_out() -> None:
    T = chair_pose()
    samples = sample_scene(room(T), chair_box(T), OPTIONS)
    assert chair_box(T).contains(samples.points, 0.05).all()
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


@pytest.mark.parametrize(
    ("attempt", "reason"),
    [
        (lambda: sample_scene(sphere(0.2), box([2, 2, 2], [3, 3, 3]), OPTIONS), "DETECTION_OUTSIDE_SCENE"),
        (lambda: sample_scene(sphere(0.2), box([0.5] * 3, [0.9] * 3), OPTIONS), "NO_SURFACE_IN_DETECTION"),
        (lambda: sample_object(sphere(0.1, (5.0, 0.0, 0.0)), OPTIONS), "NO_SURFACE_IN_OBJECT"),
        (lambda: box([0], [1, 1, 1]), "INVALID_DETECTION"),
    ],
)
def test_what_has_no_surface_is_refused(attempt: Callable[[], object], reason: str) -> None:
    with pytest.raises(RegnfError) as caught:
        attempt()
    assert caught.value.reason == reason


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_field_that_is_not_finite_is_refused(value: float) -> None:
    broken = AnalyticField(lambda points: points[:, 0] * 0 + value, [[-1, -1, -1], [1, 1, 1]])
    for attempt in (lambda: sample_scene(broken, BALL_BOX, OPTIONS), lambda: sample_object(broken, OPTIONS)):
        with pytest.raises(InvalidInputError) as caught:
            attempt()
        assert caught.value.reason == "FIELD_NOT_FINITE"


@pytest.mark.parametrize(("most", "parts_of_a_group"), [(1000, 16), (1000, 2), (3000, 1)])
def test_points_are_the_same_in_the_same_order_when_rays_are_followed_in_parts(
    most: int, parts_of_a_group: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    T = chair_pose()
    field = room(T)
    whole = sample_scene(field, chair_box(T), OPTIONS)
    traced: list[int] = []
    in_parts = partial(cast_rays, most=most)

    def counted(*arguments: Any) -> Iterator[Rays]:
        for rays in in_parts(*arguments):
            traced.append(len(rays.origins))
            yield rays

    monkeypatch.setattr("regnf_core.paper.sampling.cast_rays", counted)
    monkeypatch.setattr("regnf_core.paper.sampling._PARTS_OF_A_GROUP", parts_of_a_group)
    monkeypatch.setattr("regnf_core.surface.sphere_tracing._POINTS_AT_ONCE", 1024)
    parts = sample_scene(field, chair_box(T), OPTIONS)
    assert len(traced) > 1
    assert torch.equal(parts.points, whole.points)
    assert torch.equal(parts.normals, whole.normals)
