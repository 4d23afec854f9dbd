"""The training of the verdict's model: a known law is found again, terms stay monotone, and the table counts right."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import spearmanr

from benchmarks.worlds.calibration import auroc, calibration_table
from benchmarks.worlds.look_alikes import LOOK_ALIKE
from benchmarks.worlds.training import Evidence, train, trained
from regnf_core.robust.verdict.pose_features import SPEAKS_FOR
from regnf_core.robust.verdict.probability import LEAD, ProbabilityModel

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


def test_the_poses_that_count_are_right_on_average() -> None:
    """Every third pose is right less often than the law says; calibrated on these, that is what is said of them."""
    evidence, _ = drawn(3000, 5)
    rarer = (np.arange(3000) % 3 == 0) & (np.random.default_rng(6).uniform(size=3000) < 0.5)
    evidence = replace(evidence, right=np.where(rarer, 0.0, evidence.right))
    third = np.arange(3000) % 3 == 0
    _, by_all = train(evidence)
    _, by_third = train(replace(evidence, calibrated=third))
    said_by_all, said = (float(np.mean(1 / (1 + np.exp(-one[third])))) for one in (by_all, by_third))
    assert abs(said - float(evidence.right[third].mean())) < 0.005
    assert said_by_all > said + 0.1


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


def test_ambiguity_is_no_error_of_the_probability() -> None:
    rows = []
    for number in range(30):
        values = dict.fromkeys(NAMES, 0.5 + 0.1 * (number % 3))
        rows.append(row(number, RIGHT if number % 3 else WRONG, **values) | {"listed_mssd": RIGHT})
    _, table = trained([*rows, {**rows[0], "listed_mssd": WRONG, "world": "tsdf-9-long"}])
    assert table.startswith("21 registrations of 6 worlds, 20 with a right pose.")


def test_a_lead_over_other_answers_counts() -> None:
    """Pairs of candidates that look alike, one of them right or none: the one that lies ahead of the other is right."""
    draw = np.random.default_rng(4)
    rows = []
    for number in range(400):
        ahead = number % 2 == 0
        first, second = draw.uniform(0.6, 0.9), draw.uniform(0.1, 0.3) if ahead else draw.uniform(0.6, 0.9)
        rows.append(row(number, RIGHT if ahead else WRONG, True, (1,), confirmed=first))
        rows.append(row(number, WRONG, False, (-1,), confirmed=second))
    models, table = trained(rows)
    assert LEAD in models["among"]["terms"]
    assert LEAD not in models["alone"]["terms"]
    assert float(table.split("AUROC ")[1].split(",")[0]) > 0.95


def test_leads_may_be_by_the_odds_of_a_model_that_is_given() -> None:
    """Pairs of candidates of which ``tail`` says which one is right; the model that is given knows it, so the lead says
    it too, and no model of a pose alone is made."""
    draw = np.random.default_rng(7)
    rows = []
    for number in range(300):
        right = number % 2 == 0
        rows.append(row(number, RIGHT if right else WRONG, True, (1,), tail=draw.uniform(0.0, 0.2) + 0.5 * (not right)))
        rows.append(row(number, WRONG, False, (-1,), tail=draw.uniform(0.5, 0.7)))
    given = {"bias": 0.0, "terms": {"tail": {"knots": [0.0, 1.0], "values": [0.0, -5.0]}}}
    models, _ = trained(rows, alone=ProbabilityModel.from_dict(given))
    assert set(models) == {"among"}
    assert models["among"]["terms"][LEAD]["knots"][-1] <= 5.0 * 0.7, "leads are differences of what the model says"


def test_a_feature_that_some_rows_are_older_than_does_not_count() -> None:
    rows = [row(number, WRONG if number % 2 else RIGHT, offset=0.01 * (number % 2)) for number in range(100)]
    assert "offset" in trained(rows)[0]["alone"]["terms"]
    del rows[7]["features"]["offset"]
    assert "offset" not in trained(rows)[0]["alone"]["terms"]


def test_look_alikes_are_told_apart_in_the_table_alone() -> None:
    rows = [row(number, RIGHT if number % 2 else WRONG, confirmed=0.9 if number % 2 else 0.2) for number in range(100)]
    alike = [{**one, "model": LOOK_ALIKE, "mssd": 9.0, "listed_mssd": 9.0} for one in rows[1::2]]
    models, table = trained(rows)
    with_alike, longer = trained([*rows, *alike])
    assert with_alike == models
    assert longer.startswith(table)
    assert "accepted of 50: 50 at 0.8" in longer


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
