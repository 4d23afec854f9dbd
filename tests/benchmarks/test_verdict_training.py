"""The training of the verdict's model: a known law is found again, terms stay monotone, and the table counts right."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import spearmanr

from benchmarks.worlds.training import Evidence, train, trained
from benchmarks.worlds.trust import auroc, is_right, reliability_diagram, trust_table
from regnf_core.robust.verdict.answer import LEAD, ProbabilityModel
from regnf_core.robust.verdict.evidence import SPEAKS_FOR

NAMES = list(SPEAKS_FOR)


def row(
    number: int, error: float, winner: bool = True, others: tuple[int, ...] = (), **features: float
) -> dict[str, Any]:
    """A pose of one of eight worlds with this error; features that are not named are .5. ``others``: where the other
    candidates stand, which are other answers."""
    places = sorted([0, *others])
    return {
        "features": dict.fromkeys(NAMES, 0.5) | features,
        "model": "chair",
        "question": "right",
        "observed": True,
        "observed_by": "images",
        "scene": "tsdf",
        "length": "long",
        "case": number,
        "mssd": error,
        "listed_mssd": error,
        "seen_difference": 1.0,
        "winner": winner,
        "found": True,
        "others": list(others),
        "moved": [0.0 if place == 0 else 1.0 for place in places],
        "same": [1.0 if place == 0 else 0.0 for place in places],
        "score": 0.3,
        "world": f"tsdf-{number % 8}-long",
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


def pairs(count: int, seed: int) -> list[dict[str, Any]]:
    """Pairs of candidates that look alike, one of them right or none: the one that lies ahead of the other is right."""
    draw = np.random.default_rng(seed)
    rows = []
    for number in range(count):
        ahead = draw.random() < 0.5
        first, second = draw.uniform(0.6, 0.9), draw.uniform(0.1, 0.3) if ahead else draw.uniform(0.6, 0.9)
        for error, step, confirmed in ((RIGHT if ahead else WRONG, 1, first), (WRONG, -1, second)):
            noise = dict(zip(NAMES, draw.uniform(0.4, 0.6, len(NAMES)), strict=True))
            rows.append(row(number, error, step == 1, (step,), **noise | {"confirmed": confirmed}))
    return rows


def test_a_lead_over_other_answers_counts() -> None:
    found = trained(pairs(400, 4))
    assert LEAD in found.models["observed"]["terms"]
    assert LEAD not in found.models["alone"]["terms"]
    assert len(found.answers) == 400
    right = np.array([is_right(one) for one in found.answers])
    assert auroc(np.array([one["probability"] for one in found.answers]), right) > 0.95


def test_each_kind_of_scene_has_a_model_of_its_own() -> None:
    rows = pairs(160, 5)
    of_frames = [{**one, "scene": "frames", "case": 1000 + one["case"]} for one in rows]
    of_nothing = [{**one, "observed": False, "case": 2000 + one["case"]} for one in rows]
    assert set(trained([*rows, *of_frames, *of_nothing]).models) == {"alone", "observed", "unobserved", "thing"}


def test_nothing_is_learned_from_a_wrong_object_that_was_not_seen_to_differ() -> None:
    rows = [row(number, RIGHT if number % 2 else WRONG, confirmed=0.9 if number % 2 else 0.2) for number in range(160)]
    hidden = {"question": "part more", "mssd": 0.1, "listed_mssd": 0.1, "seen_difference": 0.0}
    alike = [{**one, **hidden, "case": 1000 + one["case"]} for one in rows[1::2]]
    without, with_alike = trained(rows), trained([*rows, *alike])
    for name, term in without.models["observed"]["terms"].items():
        assert with_alike.models["observed"]["terms"][name]["values"] == pytest.approx(term["values"], abs=0.02)
    table = trust_table(with_alike.answers)
    assert "| part more | 80 | 0 | 0 of 0 | 0 of 0 | 80 of 80 |" in table
    seen = [{**one, "seen_difference": 0.05} for one in alike]
    assert max(one["probability"] for one in trained([*rows, *seen]).answers) < 0.7, "half of such answers are wrong"


def answered(probability: float, error: float, **told: Any) -> dict[str, Any]:
    return row(0, error) | {"probability": probability, "verdict": "registered"} | told


def test_the_table_counts_answers_by_hand() -> None:
    rows = [
        answered(0.99, RIGHT), answered(0.9, RIGHT), answered(0.9, 0.07), answered(0.2, RIGHT), answered(0.1, WRONG),
        answered(0.9, WRONG, listed_mssd=RIGHT),  # one of those that it lists is right
        answered(0.99, WRONG, question="other"), answered(0.99, WRONG, question="longer", seen_difference=0.01),
        answered(0.99, RIGHT, winner=False), answered(0.99, RIGHT, found=False),
    ]  # fmt: skip
    table = trust_table(rows)
    assert "8 registrations of 1 worlds." in table
    kinds = (
        "| noisy cameras, long | 6 | 4 of 6 (66.7 %) | 3 of 6 (50.0 %) | 1 of 4 | 75.1 % | 1 of 6 (16.7 %) | 0 of 1 |"
    )
    assert kinds in table
    assert "| noisy cameras, long | 7 | 4 of 7 (57.1 %) | 3 of 7 (42.9 %) | 2 of 5 | 81.1 % |" in table
    assert "| longer | 1 | 0 | 0 of 0 | 0 of 0 | 1 of 1 |" in table
    assert "| other | 1 | 0 | 1 of 1 | 1 of 1 | 0 of 0 |" in table
    assert "Of 6 answers `registered`, 2 are wrong (at most 72.9 %)." in table


def test_variants_are_counted_by_what_tells_them_apart() -> None:
    apart = {"differs": 0.1, "seen": 0.05, "favor": 0.5, "distinguishable": True}
    alike = {**apart, "seen": 0.0, "favor": 0.0, "distinguishable": False}
    variant = {"question": "part more"}
    for_the_variant = apart | {"favor": -1.0}
    rows = [
        answered(0.5, WRONG, **variant, difference=apart), answered(0.5, WRONG, **variant, difference=for_the_variant),
        answered(0.5, WRONG, **variant, difference=alike, seen_difference=0.0),
        answered(0.5, WRONG, **variant, difference=apart, seen_difference=0.0),
        answered(0.5, RIGHT, **variant, difference=apart),  # its surface is within the tolerance: no other object
    ]  # fmt: skip
    said = trust_table(rows)
    assert (
        "candidates: 4. Reported as distinguishable: 3; of these, the evidence favors the right one in 2 of 3" in said
    )
    assert "not seen in 2; of these, reported as not distinguishable: 1 of 2" in said


def test_seeds_of_a_question_are_compared_and_counted_once() -> None:
    rows = [
        answered(0.9, RIGHT, seed=0), answered(0.7, RIGHT, seed=1, verdict="rejected"), answered(0.95, RIGHT, seed=2),
        answered(0.9, RIGHT, seed=0, question="longer"),
    ]  # fmt: skip
    said = trust_table(rows)
    assert "same verdict in 1 of 3 (33.3 %) of the pairs" in said
    assert "2 registrations of 1 worlds." in said


@pytest.mark.parametrize(("scores", "expected"), [([1.0, 2.0, 3.0, 4.0], 1.0), ([4.0, 1.0, 1.0, 2.0], 0.375)])
def test_auroc_by_hand(scores: list[float], expected: float) -> None:
    assert auroc(np.array(scores), np.array([False, False, True, True])) == pytest.approx(expected)


def test_the_diagram_shows_what_was_told_over_what_was_right() -> None:
    """Four answers of .75, three of them right."""
    drawn = reliability_diagram("a", [answered(0.75, RIGHT if number else WRONG) for number in range(4)])
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
