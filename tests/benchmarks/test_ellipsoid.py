"""The ellipsoid test on errors that have exactly the covariance they come with."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from benchmarks.robust.ellipsoid import LIMIT, calibration, mahalanobis_squared, pose_error
from regnf_core import Sim3


def some_covariance() -> Tensor:
    """Correlated, with standard deviations over four orders of magnitude."""
    generator = torch.Generator().manual_seed(5)
    spread = torch.tensor([1e-3, 2e-3, 1e-4, 0.3, 0.1, 0.2, 1e-2], dtype=torch.float64)
    mix = torch.randn(7, 7, generator=generator, dtype=torch.float64)
    correlated = mix @ mix.T + torch.eye(7, dtype=torch.float64)
    scale = correlated.diagonal().sqrt()
    return correlated / scale[:, None] / scale * spread[:, None] * spread


def some_pose() -> Sim3:
    return Sim3.from_quaternion(2.5, [0.1, -0.5, 0.3, 0.8], [0.4, -1.0, 2.0])


def test_95_percent_of_gaussian_errors_lie_inside() -> None:
    covariance, estimate = some_covariance(), some_pose()
    steps = torch.randn(400, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    squares = []
    for step in steps @ torch.linalg.cholesky(covariance).T:
        truth = estimate.perturb(step)
        squares.append(mahalanobis_squared(pose_error(estimate, truth), covariance))
    found = calibration(squares)
    assert found.count == 400
    assert found.inside == pytest.approx(0.95, abs=0.022)
    assert found.median == pytest.approx(0.907, abs=0.09)
    assert found.high == pytest.approx(LIMIT / 7, abs=0.2)


def test_too_small_a_covariance_is_seen() -> None:
    covariance = some_covariance()
    steps = torch.randn(500, 7, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    errors = steps @ torch.linalg.cholesky(covariance).T
    assert calibration([mahalanobis_squared(error, covariance / 9) for error in errors]).inside < 0.1
    assert calibration([mahalanobis_squared(error, covariance * 9) for error in errors]).inside == 1.0


def test_the_error_is_the_left_perturbation_to_the_truth() -> None:
    step = torch.tensor([0.2, -0.1, 0.3, 0.5, -0.2, 0.1, 0.15], dtype=torch.float64)
    estimate = some_pose()
    omega, scale = step[:3], float(estimate.scale) * math.exp(0.15)
    turn = Sim3.exp(torch.cat([omega, torch.zeros(4).double()]))
    truth = Sim3(torch.tensor(scale).double(), turn.rotation @ estimate.rotation, estimate.translation + step[3:6])
    assert torch.allclose(pose_error(estimate, truth), step, atol=1e-6)


@pytest.mark.parametrize("broken", [torch.full((7, 7), float("nan")), torch.zeros(7, 7), -torch.eye(7)])
def test_what_is_no_covariance_holds_nothing(broken: Tensor) -> None:
    assert mahalanobis_squared(torch.full((7,), 1e-9).double(), broken.double()) == float("inf")
