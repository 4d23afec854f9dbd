"""The covariance's two factors: the diagonal form by hand and against the engine, and factors that are found again."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from benchmarks.robust.ellipsoid import LIMIT, mahalanobis_squared
from benchmarks.worlds.covariance import Factors, diagonal_parts, fitted, markdown, squares_with
from regnf_core import Sim3
from regnf_core.robust.constants import COVARIANCE
from regnf_core.robust.verdict.covariance import in_object_units, with_common_errors
from regnf_core.robust.working_frame import WorkingFrame

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
