"""What the tables on imperfect fields compute, against values worked out by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch

from benchmarks.robust.cases import Case
from benchmarks.robust.published import Errors, better, mean_errors, nearest_equal, paper_errors
from benchmarks.robust.ranking import area_under_roc
from benchmarks.robust.symmetries import declared, turn
from regnf_core import RegistrationResult, Sim3

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


def test_means_leave_out_only_runs_without_a_pose() -> None:
    runs: list[dict[str, Any]] = [
        {"translation": 0.1, "rotation": 0.2, "scale": 0.3, "category": "rejected"},
        {"translation": 0.3, "rotation": 0.4, "scale": 0.1, "category": "registered right"},
        {"category": "failed"},
    ]
    found = mean_errors(runs)
    assert found == pytest.approx(Errors(0.2, 0.3, 0.2))
    assert mean_errors(runs[2:]) is None
    assert better(found, Errors(0.21, 0.31, 0.21))
    assert not better(found, Errors(0.21, 0.29, 0.21))
    assert not better(None, Errors(1.0, 1.0, 1.0))
