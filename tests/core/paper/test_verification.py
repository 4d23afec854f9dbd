"""The verdict: agreement is accepted, everything else is not."""

from __future__ import annotations

import math

import pytest
import torch

from regnf_core.errors import NoSurfaceError
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import SamplingOptions
from regnf_core.paper.pipeline import INLIER_DISTANCE, Verification, evaluate, verify
from regnf_core.paper.sampling import sample_scene
from regnf_core.surface.sphere_tracing import surface_bounds
from tests.core.analytic import chair, chair_box, chair_pose, room, table

OPTIONS = SamplingOptions(pixel_stride=16)


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
