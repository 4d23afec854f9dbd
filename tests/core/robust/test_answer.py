"""The answer among candidates that are placed by hand: who wins, who is listed, and how likely they are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.model import model_object
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.verdict.answer import Answer, choose, pose_odds
from regnf_core.robust.verdict.evidence import SPEAKS_FOR
from tests.core.analytic import boxes

LONG = ([-0.4, -0.1, -0.1], [0.4, 0.1, 0.1])
"""A long box: turned half about an upright axis it is the same, moved along its length by .05 nearly so."""
OBSERVED = object()
GOOD = {name: 1.0 if better else 0.0 for name, better in SPEAKS_FOR.items()}


def answer(
    shifts: list[float], scores: list[float], observation: object | None = OBSERVED, **changed: list[float]
) -> Answer:
    """Poses of a long box moved so far along its length, in diameters, all good but for the features that are
    ``changed``."""
    count = len(shifts)
    moved = torch.tensor([[shift, 0.0, 0.0] for shift in shifts]).double()
    T = Sim3(torch.ones(count).double(), torch.eye(3).double().expand(count, 3, 3), moved)
    features = {name: torch.full((count,), value).double() for name, value in GOOD.items()}
    features |= {name: torch.tensor(values).double() for name, values in changed.items()}
    problem: Any = SimpleNamespace(model=model_object(boxes([LONG])), view=SimpleNamespace(observation=observation))
    return choose(problem, PoseCandidates.start(T), features, torch.tensor(scores), 0.05)


def test_poses_that_place_nearly_the_same_do_not_compete_in_their_answer() -> None:
    """Two poses an eighth of the diameter apart fit alike; a third, elsewhere, fits worse than the margin allows."""
    found = answer([0.0, 0.12, 0.6], [0.2, 0.21, 0.5])
    single = answer([0.0, 0.6], [0.2, 0.5])
    assert (found.winner, found.rivals) == (0, [1])
    assert float(found.probability_alone[0].logit()) < float(found.probability[0].logit()) - 2.0
    assert float(found.probability[0]) == pytest.approx(float(single.probability_alone[0])), "as if it were alone"
    assert float(found.probability[2]) == pytest.approx(float(found.probability_alone[2])), "it is not listed"


def test_poses_that_place_other_surface_compete_though_both_are_listed() -> None:
    found = answer([0.0, 0.6], [0.2, 0.21])
    assert (found.winner, found.rivals) == (0, [1])
    assert torch.equal(found.probability, found.probability_alone)


def test_without_rivals_both_probabilities_are_the_same() -> None:
    found = answer([0.0, 0.03, 0.6], [0.2, 0.21, 0.5])
    assert found.rivals == []
    assert torch.equal(found.probability, found.probability_alone)


def test_what_fits_by_its_score_and_is_much_less_likely_is_no_rival() -> None:
    found = answer([0.0, 0.5], [0.2, 0.2], seen_through=[0.0, 0.9], object_agrees=[1.0, 0.2])
    assert (found.winner, found.rivals) == (0, [])


def test_what_is_known_of_the_scene_decides_on_the_model() -> None:
    """The same numbers mean another probability where nobody says what was seen."""
    told, silent = (answer([0.0, 0.6], [0.2, 0.5], one, noise=[0.01, 0.01]) for one in (OBSERVED, None))
    assert float(told.probability[0]) != float(silent.probability[0])
    assert float(told.probability[0]) == pytest.approx(float(_said(True)), abs=1e-9)
    assert float(silent.probability[0]) == pytest.approx(float(_said(False)), abs=1e-9)


def _said(observed: bool) -> torch.Tensor:
    features = {name: torch.full((2,), value).double() for name, value in GOOD.items()} | {
        "noise": torch.tensor([0.01, 0.01]).double()
    }
    return (
        pose_odds(observed)
        .log_odds(features, torch.tensor([0.2, 0.5]).double(), ~torch.eye(2, dtype=torch.bool))
        .sigmoid()[0]
    )
