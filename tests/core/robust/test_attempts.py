"""How often a pose is searched for: once more where the first answer is rejected or leaves doubt."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from regnf_core.library import register
from regnf_core.robust.constants import VERDICT
from regnf_core.robust.search.distance_grid import feature_seeds
from tests.core.analytic import chair, chair_pose, room
from tests.core.robust.shapes import ROBUST, can, detection, placement_error


@pytest.fixture
def thorough(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """One entry for each thorough search, of which feature matches are a part."""
    searches: list[int] = []

    def counted(*arguments: Any) -> Any:
        searches.append(1)
        return feature_seeds(*arguments)

    monkeypatch.setattr("regnf_core.robust.pipeline.feature_seeds", counted)
    return searches


@pytest.mark.parametrize(("doubtful", "more"), [(0.9, 0), (1.0, 1)])
def test_an_accepted_answer_that_leaves_doubt_is_searched_for_once_more(
    doubtful: float, more: int, thorough: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("regnf_core.robust.verdict.evaluation.VERDICT", replace(VERDICT, doubtful=doubtful))
    result = register(room(chair_pose()), chair(), detection(), ROBUST, clouds=False)
    assert len(thorough) == more
    assert result.verdict == "registered"
    assert 0.95 < result.metrics["probability"] < 1.0
    assert placement_error(result, chair_pose()) < 0.005


def test_a_rejected_answer_is_searched_for_once_more(thorough: list[int]) -> None:
    assert register(room(chair_pose()), can(), detection(), ROBUST, clouds=False).verdict == "rejected"
    assert thorough == [1]
