"""The training of the verdict's model: a known law is found again, terms stay monotone, and the table counts right."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import spearmanr

from benchmarks.worlds.calibration import auroc, calibration_table
from benchmarks.worlds.comparing import compared_line
from benchmarks.worlds.look_alikes import LOOK_ALIKE
from benchmarks.worlds.reliability import reliability_diagram
from benchmarks.worlds.similar_objects import SIMILAR
from benchmarks.worlds.training import Evidence, train, trained
from regnf_core.robust.verdict.answer import LEAD, ProbabilityModel
from regnf_core.robust.verdict.evidence import SPEAKS_FOR

NAMES = list(SPEAKS_FOR)


def row(
    number: int, error: float, winner: bool = True, others: tuple[int, ...] = (), **features: float
) -> dict[str, Any]:
    """A pose of one of five worlds with this error; features that are not named are .5."""
    return {
        "features": dict.fromkeys(NAMES, 0.5) | features,
        "model": "chair",
        "mssd": error,
        "listed_mssd": error,
        "winner": winner,
        "found": True,
        "others": list(others),
        "score": 0.3,
        "world": f"tsdf-{number % 5}-long",
    }


RIGHT, WRONG = 0.01, 0.6


def drawn(count: int, seed: int) -> tuple[Evidence, np.ndarray]:
    """Poses whose log odds follow ``confirmed`` and ``free``; the other features say nothing."""
    draw = np.random.default_rng(seed)
    features = draw.uniform(0.0, 1.0, (count, len(NAMES)))
    logit = 6.0 * features[:, NAMES.index("confirmed")] - 4.0 * features[:, NAMES.index("free")] - 1.0
    right = (draw.uniform(size=count) < 1.0 / (1.0 + np.exp(-logit))).astype(float)
    return Evidence(tuple(NAMES), features, right, np.ones(count), np.arange(count) % 7, np.ones(count, bool)), logit


def test_a_known_law_is_found_again() -> None:
    evidence, _ = drawn(3000, 0)
    model, left_out = train(evidence)
    fresh, logit = drawn(2000, 1)
    found = model.logit(fresh.features)
    assert spearmanr(found, logit).statistic > 0.97
    assert abs(float(np.mean(1 / (1 + np.exp(-found)))) - float(fresh.right.mean())) < 0.03
    assert abs(float(np.mean(1 / (1 + np.exp(-left_out)))) - float(evidence.right.mean())) < 0.005


def test_the_stored_model_says_the_same() -> None:
    evidence, _ = drawn(800, 2)
    model, _ = train(evidence)
    stored = ProbabilityModel.from_dict(model.to_dict())
    features = {name: torch.from_numpy(evidence.features[:, i]) for i, name in enumerate(NAMES)}
    np.testing.assert_allclose(stored.logit(features).numpy(), model.logit(evidence.features), atol=0.03)


def test_a_feature_that_speaks_the_wrong_way_does_not_count() -> None:
    evidence, _ = drawn(2000, 3)
    turned = evidence.features.copy()
    turned[:, NAMES.index("hidden")] = evidence.right + 0.01 * turned[:, NAMES.index("hidden")]
    model, _ = train(replace(evidence, features=turned))
    assert "hidden" not in model.to_dict()["terms"]  # more that is hidden must not make a pose likelier


def test_a_lead_over_other_answers_counts() -> None:
    """Pairs of candidates that look alike, one of them right or none: the one that lies ahead of the other is right."""
    draw = np.random.default_rng(4)
    rows = []
    for number in range(400):
        ahead = number % 2 == 0
        first, second = draw.uniform(0.6, 0.9), draw.uniform(0.1, 0.3) if ahead else draw.uniform(0.6, 0.9)
        for error, step, confirmed in ((RIGHT if ahead else WRONG, 1, first), (WRONG, -1, second)):
            noise = dict(zip(NAMES, draw.uniform(0.4, 0.6, len(NAMES)), strict=True))
            rows.append(row(number, error, step == 1, (step,), **noise | {"confirmed": confirmed}))
    alone = trained(rows)
    among = trained(rows, alone=ProbabilityModel.from_dict(alone.model["alone"]))
    assert LEAD in among.model["among"]["terms"]
    assert LEAD not in alone.model["alone"]["terms"]
    assert _auroc_of(among.table) > 0.95 > _auroc_of(alone.table)


def _auroc_of(table: str) -> float:
    return float(table.split("AUROC ")[1].split(",")[0])


@pytest.mark.parametrize("model", [LOOK_ALIKE, SIMILAR])
def test_what_is_nearly_the_right_object_is_told_in_the_table_alone(model: str) -> None:
    rows = [row(number, RIGHT if number % 2 else WRONG, confirmed=0.9 if number % 2 else 0.2) for number in range(100)]
    alike = [{**one, "model": model, "mssd": 9.0, "listed_mssd": 9.0} for one in rows[1::2]]
    without, with_alike = trained(rows), trained([*rows, *alike])
    assert with_alike.model == without.model
    assert with_alike.table.startswith(without.table)
    assert "accepted of 50: 50 at 0.8" in with_alike.table


def test_nothing_is_learned_of_rows_that_are_measured() -> None:
    rows = [row(number, RIGHT if number % 2 else WRONG, confirmed=0.9 if number % 2 else 0.2) for number in range(100)]
    turned = [{**one, "mssd": WRONG, "listed_mssd": WRONG} for one in rows[1::2]]
    similar = [{**one, "model": SIMILAR} for one in turned[:7]]
    plain, measured = trained(rows), trained(rows, measured=[*turned, *similar])
    assert measured.model == plain.model
    assert measured.diagram == plain.diagram
    assert measured.table.startswith(plain.table)
    assert "accepted of 7: 7 at 0.8" in measured.table


def test_candidates_are_compared_by_hand() -> None:
    """Four cases of both objects: the right one ahead, behind, ahead but rejected, and at a wrong pose, which does not
    count; a fifth case has the right object alone."""

    def best(case: int, model: str, score: float, verdict: str = "registered", error: float = RIGHT) -> dict[str, Any]:
        return row(0, error) | {"case": case, "model": model, "verdict": verdict, "score": score}

    rows = [
        best(0, "chair", 0.1), best(0, SIMILAR, 0.2),
        best(1, "chair", 0.2), best(1, SIMILAR, 0.1),
        best(2, "chair", 0.1, "rejected"), best(2, SIMILAR, 0.2),
        best(3, "chair", 0.1, error=WRONG), best(3, SIMILAR, 0.2),
        best(4, "chair", 0.1),
    ]  # fmt: skip
    line = compared_line(SIMILAR, rows, np.zeros(len(rows)))
    assert line == "By what candidates are compared by, the right object comes first in 1 of 3.\n"
    by_odds = compared_line(SIMILAR, rows, np.array([0.0, 9.0, 9.0, 0.0, 0, 0, 0, 0, 0]))
    assert "in 1 of 3" in by_odds  # the first two cases change places
    assert compared_line(LOOK_ALIKE, rows, np.zeros(len(rows))) == ""


def test_the_table_counts_what_was_chosen() -> None:
    rows = [
        {"winner": True, "mssd": 0.01, "world": "a"},
        {"winner": True, "mssd": 0.07, "world": "a"},
        {"winner": True, "mssd": 0.5, "world": "b"},
        {"winner": False, "mssd": 0.01, "world": "b"},
    ]
    table = calibration_table(rows, np.array([4.0, 3.0, -4.0, 5.0]))
    assert "3 registrations of 2 worlds, 1 with a right pose. AUROC 1.0000" in table
    assert "| 0.9 | 1 of 1 | 5 % | 1 of 2 | 97.5 % | 0 |" in table


@pytest.mark.parametrize(("scores", "expected"), [([1.0, 2.0, 3.0, 4.0], 1.0), ([4.0, 1.0, 1.0, 2.0], 0.375)])
def test_auroc_by_hand(scores: list[float], expected: float) -> None:
    assert auroc(np.array(scores), np.array([False, False, True, True])) == pytest.approx(expected)


def test_the_diagram_shows_what_was_said_over_what_was_right() -> None:
    """Four poses of .75, three of them right; one that no registration chose is not drawn."""
    rows = [{"winner": True, "mssd": RIGHT if number else WRONG, "world": "a"} for number in range(4)]
    logits = np.full(5, math.log(3.0))
    drawn = reliability_diagram([*rows, {"winner": False, "mssd": RIGHT, "world": "a"}], logits)
    picture = ElementTree.fromstring(drawn)
    square, *points = picture.findall(".//{*}rect[@class='frame']") + picture.findall(".//{*}circle")
    assert len(points) == 1
    left, top, edge = (float(square.attrib[name]) for name in ("x", "y", "width"))
    assert (float(points[0].attrib["cx"]) - left) / edge == pytest.approx(0.75, abs=1e-3)
    assert 1.0 - (float(points[0].attrib["cy"]) - top) / edge == pytest.approx(0.75, abs=1e-3)
    bounds = picture.find(".//{*}line[@class='bounds']")
    assert bounds is not None
    low, high = (1.0 - (float(bounds.attrib[name]) - top) / edge for name in ("y1", "y2"))
    assert low == pytest.approx(0.249, abs=1e-3)  # the p of which 3 or 4 of 4 have a chance of 5 %
    assert high == pytest.approx(0.987, abs=1e-3)  # 0.95 ** (1 / 4): of which 4 of 4 have a chance of 95 %
