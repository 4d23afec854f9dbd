"""The engine still gives the results that were recorded for its revision."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest
import torch

from tests.golden.cases import cases
from tests.golden.records import Recorded, differences, record_of

CASES = {case.name: case for case in cases()}


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("name", sorted(CASES))
def test_a_golden_registration_gives_the_recorded_result(name: str) -> None:
    case = CASES[name]
    found = list(differences(case, Recorded.load().results[name], record_of(case.run())))
    assert not found, "\n".join([*found, "If this is intended: python -m scripts.engine_revision"])


def test_each_recorded_result_has_its_case() -> None:
    assert set(Recorded.load().results) == set(CASES)


def _change(name: str, change: Any) -> list[str]:
    """The differences between a recorded result and the same after ``change``."""
    recorded = Recorded.load().results[name]
    changed = copy.deepcopy(recorded)
    change(changed)
    return list(differences(CASES[name], recorded, changed))


@pytest.mark.parametrize(("name", "limit"), [("robust-any-orientation", 1e-6), ("robust-neural-fields", 5e-5)])
def test_a_pose_that_moved_is_a_difference(name: str, limit: float) -> None:
    def move(by: float, result: dict[str, Any]) -> None:
        result["T_object_scene"][0][3] += by * limit * result["metrics"]["object_diameter"]

    assert [len(_change(name, partial(move, by))) for by in (0.9, 1.1)] == [0, 1]


def test_equally_good_poses_may_come_in_another_order() -> None:
    def swap(result: dict[str, Any]) -> None:
        result["T_object_scene"], result["alternatives"][0] = result["alternatives"][0], result["T_object_scene"]

    def repeat(result: dict[str, Any]) -> None:
        result["alternatives"][0] = result["T_object_scene"]

    assert [len(_change("robust-several-poses", change)) for change in (swap, repeat)] == [0, 1]


def test_verdict_reason_poses_and_metrics_are_compared() -> None:
    name = "robust-several-poses"
    for change in (
        lambda result: result.update(verdict="registered"),
        lambda result: result.update(verdict_reason="SURFACES_AGREE"),
        lambda result: result["alternatives"].pop(),
        lambda result: result["metrics"].update(field_evaluations=1e6),
        lambda result: result["metrics"].update(residual_rms=0.01),
    ):
        assert len(_change(name, change)) == 1
