"""The ellipsoid test on errors that have exactly the covariance they come with."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.robust.cases import Case
from benchmarks.robust.ellipsoid import LIMIT, calibration, mahalanobis_squared, pose_error
from benchmarks.robust.published import nearest_equal, paper_errors
from benchmarks.robust.ranking import area_under_roc
from benchmarks.robust.symmetries import declared, turn
from benchmarks.worlds.covariance import Factors, diagonal_parts, fitted, markdown, squares_with
from regnf_core import RegistrationResult, Sim3
from regnf_core.robust.constants import COVARIANCE
from regnf_core.robust.verdict.covariance import in_object_units, with_common_errors
from regnf_core.robust.working_frame import WorkingFrame


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


# The covariance's two factors: the diagonal form by hand and against the engine, and factors that are found again.

K, A = COVARIANCE.residuals_factor, COVARIANCE.offset_factor


def _positive(seed: int) -> torch.Tensor:
    root = torch.randn(7, 12, generator=torch.Generator().manual_seed(seed)).double()
    return root @ root.mT / 12.0


def test_both_parts_are_those_of_the_engine_in_the_objects_own_units() -> None:
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(0)).double() * torch.tensor([0.3, 0.2, 0.1])
    scene = WorkingFrame(torch.tensor([4.0, -2.0, 1.0]).double(), 3.0)
    obj = WorkingFrame(torch.tensor([0.5, 0.0, -7.0]).double(), 0.25)
    T = Sim3.exp(torch.tensor([0.3, -0.2, 0.9, 0.1, 0.2, -0.1, 0.2]).double())
    own = Sim3(torch.tensor(obj.length).double(), torch.eye(3).double(), obj.center) @ T
    own = own @ Sim3(torch.tensor(scene.length).double(), torch.eye(3).double(), scene.center).inverse()
    tells, offset = 1e-4 * _positive(1), 0.004
    both, without = (
        in_object_units(with_common_errors(tells, points, T, some), T, scene, obj) for some in (offset, 0.0)
    )
    error = 0.01 * torch.randn(7, generator=torch.Generator().manual_seed(2)).double()
    placed = points * obj.length + obj.center
    told = diagonal_parts(error, both, placed, own, offset * obj.length)
    assert sum(value**2 for value in told["whitened_error"]) == pytest.approx(mahalanobis_squared(error, both))
    # The share of the offset in a direction v is v' O v / v' C v: by another route, the eigenvalues of C^-1 O.
    expected = torch.linalg.eigvals(torch.linalg.solve(both, both - without)).real.sort().values
    assert told["offset_share"] == pytest.approx(expected.tolist(), abs=1e-4)
    assert 0.01 < expected[0] < expected[-1] < 0.999
    # With other factors: as if the engine had had them.
    other = (without / K) * 2.0 + (both - without) / A**2
    run = {"whitened_error": told["whitened_error"], "offset_share": told["offset_share"]}
    (square,) = squares_with([run], Factors(2.0, 1.0, math.nan))
    assert square == pytest.approx(mahalanobis_squared(error, other), rel=1e-3)


def _drawn(count: int, part: str, residuals: float, offset: float, freedom: float) -> list[dict[str, object]]:
    """Errors of a Student distribution whose two parts are this many times as large as the engine says."""
    rng = np.random.default_rng(5)
    shares = rng.uniform(size=(count, 7)) ** 2
    spread = np.sqrt(residuals * (1.0 - shares) + offset * shares)
    heavy = np.sqrt(freedom / rng.chisquare(freedom, size=(count, 1)))
    errors = rng.normal(size=(count, 7)) * spread * heavy
    return [
        {"whitened_error": error, "offset_share": share, "part": part, "known_scale": None}
        for error, share in zip(errors.tolist(), shares.tolist(), strict=True)
    ]


def test_factors_are_found_again() -> None:
    runs = _drawn(4000, "train", residuals=4.0, offset=0.25, freedom=3.0)
    found = fitted(runs)
    assert found.freedom == pytest.approx(3.0, rel=0.1)
    # Both are scaled alike, to hold 95 % of the errors; their ratio is the drawn one.
    assert (found.residuals / K) / (found.offset / A) ** 2 == pytest.approx(4.0 / 0.25, rel=0.1)
    assert float((squares_with(runs, found) <= LIMIT).mean()) == pytest.approx(0.95, abs=0.005)


def test_the_table_has_each_parts_factors_on_every_part_and_leaves_known_scales_out() -> None:
    train, validation = _drawn(60, "train", 1.0, 1.0, 5.0), _drawn(40, "validation", 1.0, 1.0, 5.0)
    known = [{**train[0], "known_scale": 0.01}, {"part": "train", "mahalanobis_squared": None}]
    lines = markdown([*train, *validation, *known]).splitlines()
    assert [line.split(" | ")[0].strip("| ") for line in lines[2:]] == ["train", "validation", "all", "the engine's"]
    assert lines[2].split(" | ")[1] == "60"
    assert lines[-1].split(" | ")[2:4] == [f"{K:g}", f"{A:g}"]
    inside = sum(sum(value**2 for value in run["whitened_error"]) <= LIMIT for run in train)  # type: ignore[attr-defined]
    assert f" {inside} of 60 " in lines[-1]


# What the tables on imperfect fields compute, against values worked out by hand.

Z = (0.0, 0.0, 1.0)
POINTS = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.5, 0.3], [0.2, -1.0, 0.1]])


def test_the_area_is_the_share_of_pairs_in_the_right_order() -> None:
    # 0.9 beats all three; 0.5 beats 0.3, ties with 0.5, loses to 0.6: 3 + 1.5 of 6 pairs.
    assert area_under_roc([0.9, 0.5], [0.3, 0.5, 0.6]) == pytest.approx(4.5 / 6)
    assert area_under_roc([0.9, 0.8], [0.1]) == 1.0
    assert area_under_roc([0.1], [0.2, 0.3]) == 0.0
    assert math.isnan(area_under_roc([], [0.5]))


@pytest.mark.parametrize("degrees", [0.0, 90.0, 180.0, 270.0])
def test_the_nearest_equal_of_the_truth_is_the_one_that_was_found(degrees: float) -> None:
    truth = Sim3.from_quaternion(1.3, [0.1, 0.2, 0.3, 0.9], [0.2, -0.1, 0.4])
    slightly_off = Sim3.from_translation(torch.tensor([0.03, 0.0, 0.0]).double())
    estimate = slightly_off @ turn(Z, degrees) @ truth
    largest, equal = nearest_equal(estimate, truth, POINTS, declared("et"))
    assert largest == pytest.approx(0.03)
    assert torch.allclose(equal.matrix(), (turn(Z, degrees) @ truth).matrix(), atol=1e-12)


def test_the_papers_metrics_take_the_best_pose_listed() -> None:
    truth = Sim3.from_translation(torch.tensor([0.1, 0.2, 0.3]).double())
    near = Sim3.from_quaternion(1.02, [0.0, 0.0, math.sin(0.03), math.cos(0.03)], [0.13, 0.2, 0.3])
    far = turn(Z, 90.0) @ truth
    result = SimpleNamespace(
        T_object_scene=far,
        alternatives=[SimpleNamespace(T_object_scene=near)],
        object_samples=SimpleNamespace(points=POINTS),
    )
    case = SimpleNamespace(truth=truth, symmetries=declared("c"))
    errors = paper_errors(cast("Case", case), cast("RegistrationResult", result))
    assert errors["translation"] == pytest.approx(0.03 / math.sqrt(3))
    assert errors["rotation"] == pytest.approx(0.06 / math.sqrt(3))
    assert errors["scale"] == pytest.approx(0.02)
