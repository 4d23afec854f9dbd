"""FPFH, RANSAC and ICP on clouds of the analytic chair."""

from __future__ import annotations

from functools import cache

import pytest
import torch

from regnf_core.errors import InitializationError
from regnf_core.geometry.metrics import rotation_error
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import InitializationOptions, SamplingOptions
from regnf_core.paper.pipeline import initial_transform
from regnf_core.paper.sampling import sample_object, sample_scene
from regnf_core.surface.result_clouds import mean_residual
from tests.core.analytic import chair, chair_box, chair_pose, room

OPTIONS = InitializationOptions()


@cache
def clouds(scale: float) -> tuple[Sim3, SurfaceSamples, SurfaceSamples]:
    T = chair_pose(scale)
    sampling = SamplingOptions(pixel_stride=12)
    return T, sample_scene(room(T), chair_box(T), sampling), sample_object(chair(), sampling)


def test_equal_scales_are_aligned_closely() -> None:
    T, A, B = clouds(1.0)
    found = initial_transform(A, B, OPTIONS, seed=1)
    assert float(found.scale) == pytest.approx(1.0, abs=1e-9)
    assert rotation_error(found, T) < 0.1
    assert float(chair().signed_distance(found.apply(A.points)).abs().median()) < 0.01


def test_the_seed_decides_and_nothing_else() -> None:
    _, A, B = clouds(1.25)
    first, again, other = (initial_transform(A, B, OPTIONS, seed).matrix() for seed in (3, 3, 4))
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
            initial_transform(cloud, B, OPTIONS, seed=0)
        assert caught.value.reason == "NO_INITIAL_TRANSFORM"


def test_standard_output_stays_the_callers(capfd: pytest.CaptureFixture[str]) -> None:
    _, A, B = clouds(1.25)
    initial_transform(SurfaceSamples(A.points[::12], A.normals[::12]), B, OPTIONS, seed=0)
    assert capfd.readouterr().out == ""
