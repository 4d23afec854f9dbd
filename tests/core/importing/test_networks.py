"""Networks of plain layers: random configurations, with what their settings say, and what is found without."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.importing.gate.convert import convert_file
from regnf_core.importing.gate.report import ImportLimits
from tests.core.importing.archives import assert_refused
from tests.core.importing.networks.cases import FAMILIES, Case
from tests.core.importing.networks.judging import judged

EACH = 3


def case_of(family: str, number: int, steps: int = 0) -> Case:
    return FAMILIES[family](np.random.default_rng([2026, number]), steps)


@pytest.mark.parametrize("number", range(EACH))
@pytest.mark.parametrize("family", FAMILIES)
def test_a_random_network_is_what_its_settings_say(family: str, number: int, tmp_path: Path) -> None:
    case = case_of(family, number)
    found = judged(case, case.beside | case.said, tmp_path)
    assert found.refused is None, found.detail
    assert found.value < 1e-5
    assert found.gradient < 1e-3


@pytest.mark.parametrize("family", FAMILIES)
def test_a_random_network_without_settings_is_never_guessed_at(family: str, tmp_path: Path) -> None:
    """It is no distance: its behavior says nothing. The message has what to say."""
    found = judged(case := case_of(family, 1), case.beside, tmp_path)
    assert found.refused == "LAYOUT_AMBIGUOUS"
    assert "to the import options" in found.detail
    assert any(name in found.detail for name in case.said)


@pytest.mark.parametrize(
    ("family", "said", "reason"),
    [
        ("neus", {"positional_encoding": {"degree": 20}}, "SETTINGS_CONTRADICT_TENSORS"),
        ("neus", {"input_scale": 1.0, "output_column": 300}, "SETTINGS_CONTRADICT_TENSORS"),
        ("siren", {"activation_scale": 30.0, "output_column": 1}, "SETTINGS_CONTRADICT_TENSORS"),
        ("neus", {"level_mask": 3}, "INVALID_DESCRIPTION"),
        ("siren", {"activation": "relu", "activation_scale": 3.0}, "INVALID_DESCRIPTION"),
        ("siren", {"activation": "leaky_relu", "activation_scale": 3.0}, "INVALID_DESCRIPTION"),
        ("neus", {"first_activation_scale": 3.0}, "INVALID_DESCRIPTION"),
        ("neus", {"input_scale": 1.0, "output_tanh": 1, "output_bias": 1.0}, "INVALID_DESCRIPTION"),
        ("deepsdf", {"family": "neus"}, "FAMILY_NOT_SUPPORTED"),
    ],
)
def test_what_the_tensors_exclude_is_refused(family: str, said: dict[str, Any], reason: str, tmp_path: Path) -> None:
    case = case_of(family, 0)
    assert judged(case, case.beside | said, tmp_path).refused == reason


def test_layers_of_no_known_family_are_not_guessed_at(tmp_path: Path) -> None:
    torch.save({"a.weight": torch.ones(4, 3), "b.weight": torch.ones(1, 4)}, tmp_path / "upload")
    assert_refused(lambda: convert_file(tmp_path / "upload", tmp_path, None, ImportLimits()), "FIELD_NOT_RECOGNIZED")


@pytest.mark.long
@pytest.mark.parametrize("number", range(2))
@pytest.mark.parametrize("family", FAMILIES)
def test_a_trained_network_is_never_silently_wrong(family: str, number: int, tmp_path: Path) -> None:
    case = case_of(family, number, steps=150)
    found = judged(case, case.beside, tmp_path)
    assert found.refused in (None, "LAYOUT_AMBIGUOUS"), found.detail
    assert found.value < 1e-3


@pytest.mark.parametrize("number", [0, 2])
def test_the_usual_factor_of_a_siren_is_confirmed_and_another_asked(number: int, tmp_path: Path) -> None:
    case = case_of("siren", number, steps=200)
    found = judged(case, {}, tmp_path)
    assert found.refused == (None if case.said == {"activation_scale": 30.0} else "LAYOUT_AMBIGUOUS"), found.detail
    assert found.value < 1e-5
