"""Surface points of scene and object as cameras see them, against shapes whose surface is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import pytest
import torch

from regnf_core.errors import InitializationError, InvalidInputError, NoSurfaceError, RegnfError
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.metrics import rotation_error
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import Axis, InitializationOptions, SamplingOptions
from regnf_core.paper.pipeline import INLIER_DISTANCE, Verification, evaluate, initial_transform, verify
from regnf_core.paper.sampling import sample_object, sample_scene
from regnf_core.surface.result_clouds import mean_residual
from regnf_core.surface.sphere_tracing import Rays, cast_rays, surface_bounds
from tests.core.analytic import AnalyticField, chair, chair_box, chair_pose, room, sphere, table

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


# FPFH, RANSAC and ICP on clouds of the analytic chair.


MATCHING = InitializationOptions()


@cache
def clouds(scale: float) -> tuple[Sim3, SurfaceSamples, SurfaceSamples]:
    T = chair_pose(scale)
    sampling = SamplingOptions(pixel_stride=12)
    return T, sample_scene(room(T), chair_box(T), sampling), sample_object(chair(), sampling)


def test_equal_scales_are_aligned_closely() -> None:
    T, A, B = clouds(1.0)
    found = initial_transform(A, B, MATCHING, seed=1)
    assert float(found.scale) == pytest.approx(1.0, abs=1e-9)
    assert rotation_error(found, T) < 0.1
    assert float(chair().signed_distance(found.apply(A.points)).abs().median()) < 0.01


def test_the_seed_decides_and_nothing_else() -> None:
    _, A, B = clouds(1.25)
    first, again, other = (initial_transform(A, B, MATCHING, seed).matrix() for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_of_several_draws_the_one_the_fields_agree_with_is_kept() -> None:
    T, A, B = clouds(1.25)
    scene, obj = room(T), chair()

    def score(candidate: Sim3) -> float:
        return mean_residual(scene, obj, A.points[::8], B.points[::8], candidate, 0.1)

    seen: list[float] = []

    def remember(candidate: Sim3) -> float:
        seen.append(score(candidate))
        return seen[-1]

    chosen = initial_transform(A, B, InitializationOptions(draws=6), 0, remember)
    assert len(seen) == 6
    assert score(chosen) == min(seen)
    assert rotation_error(chosen, T) < 0.5


def test_too_small_a_cloud_and_one_of_wholly_different_size_give_no_transform() -> None:
    _, A, B = clouds(1.0)
    for cloud in (A[:5], SurfaceSamples(A.points * 40, A.normals)):
        with pytest.raises(InitializationError) as caught:
            initial_transform(cloud, B, MATCHING, seed=0)
        assert caught.value.reason == "NO_INITIAL_TRANSFORM"


def test_standard_output_stays_the_callers(capfd: pytest.CaptureFixture[str]) -> None:
    _, A, B = clouds(1.25)
    initial_transform(SurfaceSamples(A.points[::12], A.normals[::12]), B, MATCHING, seed=0)
    assert capfd.readouterr().out == ""


# The verdict: agreement is accepted, everything else is not.


def residuals(near: int, far: int, distance: float) -> torch.Tensor:
    return torch.cat([torch.zeros(near), torch.full((far,), distance)])


@pytest.mark.parametrize(
    ("scene_to_object", "object_to_scene", "expected"),
    [
        (residuals(100, 0, 0), residuals(100, 0, 0), "SURFACES_AGREE"),
        (residuals(85, 15, 0.02), residuals(100, 0, 0), "SURFACES_AGREE"),
        (residuals(75, 25, 0.02), residuals(100, 0, 0), "LOW_OVERLAP"),
        (residuals(100, 0, 0), residuals(75, 25, -0.02), "LOW_OVERLAP"),
        (residuals(85, 15, 0.2), residuals(100, 0, 0), "LARGE_RESIDUAL"),
        (torch.full((10,), math.nan), residuals(100, 0, 0), "LOW_OVERLAP"),
        (torch.tensor([0.0, 0, 0, 0, 0, math.nan]), residuals(5, 0, 0), "LARGE_RESIDUAL"),
    ],
)
def test_verdicts_by_hand(scene_to_object: torch.Tensor, object_to_scene: torch.Tensor, expected: str) -> None:
    found = evaluate(scene_to_object, object_to_scene)
    assert found.reason == expected
    assert found.verdict == ("registered" if expected == "SURFACES_AGREE" else "rejected")


def test_the_numbers_behind_a_verdict() -> None:
    metrics = evaluate(residuals(9, 1, 0.1), residuals(8, 2, -0.1)).metrics
    assert metrics["inlier_share_scene"] == pytest.approx(0.9)
    assert metrics["inlier_share_object"] == pytest.approx(0.8)
    assert metrics["residual_rms"] == pytest.approx(math.sqrt(3 * 0.01 / 20))
    assert metrics["free_space_violations"] == 0.0  # the scene has more matter there, not less
    assert evaluate(residuals(9, 1, 0.1), residuals(8, 2, 0.1)).metrics["free_space_violations"] == pytest.approx(0.2)


def test_views_that_see_too_little_are_looked_at_more_closely() -> None:
    # 100 points or so at first: a quarter of the rays would find fewer than the fifty that are asked for.
    truth, obj = chair_pose(), chair()
    options = SamplingOptions(pixel_stride=40)
    first = sample_scene(room(truth), chair_box(truth), options)
    assert 50 <= len(first.points) < 150
    found = verify(room(truth), obj, chair_box(truth), surface_bounds(obj), truth, options, 1.1)
    assert found.verdict == "registered"


def test_no_surface_for_the_verdict_is_said_in_the_end() -> None:
    truth, obj = chair_pose(), chair()
    far = OrientedBox.from_corners([-0.9, -0.9, 0.7], [-0.7, -0.7, 0.9])
    with pytest.raises(NoSurfaceError) as caught:
        verify(room(truth), obj, far, surface_bounds(obj), truth, SamplingOptions(pixel_stride=40), 1.1)
    assert caught.value.reason == "NO_SURFACE_IN_DETECTION"


def verdict_of(T: Sim3, obj: SdfField | None = None) -> Verification:
    truth, obj = chair_pose(), obj or chair()
    return verify(room(truth), obj, chair_box(truth), surface_bounds(obj), T, OPTIONS, 1.1)


def test_the_truth_is_accepted() -> None:
    found = verdict_of(chair_pose())
    assert found.verdict == "registered"
    assert found.metrics["residual_rms"] < INLIER_DISTANCE / 3


@pytest.mark.parametrize("k", [1, 4, 6])
def test_a_transform_off_by_0_15_is_refused(k: int) -> None:
    tangent = torch.zeros(7, dtype=torch.float64)
    tangent[k] = 0.15
    assert verdict_of(Sim3.exp(tangent) @ chair_pose()).verdict == "rejected"


def test_collapsing_the_scene_to_a_point_of_the_surface_is_refused() -> None:
    tiny = Sim3.from_quaternion(1e-3, [0, 0, 0, 1], [0.0, 0.0, 0.02])
    assert verdict_of(tiny).verdict == "rejected"


def test_another_object_in_the_chairs_place_is_refused() -> None:
    assert verdict_of(chair_pose(), table()).verdict == "rejected"
