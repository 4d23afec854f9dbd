"""Networks of plain layers: random configurations, with what their settings say, and what is found without."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from tests.core.importing.networks.cases import FAMILIES, Case
from tests.core.importing.networks.judging import judged

EACH = 3
ONE_OUT = torch.ones(1, 4)


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


@pytest.mark.parametrize("family", [family for family in FAMILIES if family != "idr, volsdf"])
def test_a_random_network_without_settings_is_never_guessed_at(family: str, tmp_path: Path) -> None:
    """It is no distance: its behavior says nothing. The message has what to say."""
    found = judged(case := case_of(family, 1), case.beside, tmp_path)
    assert found.refused == "LAYOUT_AMBIGUOUS"
    assert "in the description" in found.detail
    assert any(name in found.detail for name in case.said)


def test_a_network_that_is_finite_in_no_form_is_not_asked_about(tmp_path: Path) -> None:
    state = {"a.weight": torch.full((6, 3), 3e38), "a.bias": torch.zeros(6), "b.weight": torch.full((1, 6), 3e38)}
    torch.save(state | {"b.bias": torch.zeros(1)}, tmp_path / "upload")
    with pytest.raises(FieldFormatError) as caught:
        convert_file(tmp_path / "upload", tmp_path, {"output_tanh": 0}, ImportLimits())
    assert caught.value.reason == "FIELD_NOT_FINITE"


def test_a_network_that_is_a_distance_tells_its_form(tmp_path: Path) -> None:
    """Two neurons a coordinate make |x| + |y| + |z|: the gradient has length sqrt 3, unless it is divided by that."""
    first = torch.cat((torch.eye(3), -torch.eye(3)))
    state = {"a.weight": first, "a.bias": torch.zeros(6), "b.weight": torch.full((1, 6), 3.0**-0.5)}
    state["b.bias"] = torch.tensor([-0.5])
    torch.save(state, tmp_path / "upload")
    said = {"output_tanh": 0}
    with pytest.raises(FieldFormatError) as caught:
        convert_file(tmp_path / "upload", tmp_path, said, ImportLimits())
    assert caught.value.reason == "LAYOUT_AMBIGUOUS"
    assert "relu" in str(caught.value)
    report = convert_file(tmp_path / "upload", tmp_path, said | {"activation": "relu"}, ImportLimits())
    assert report["family"] == "plain_network"
    assert report["plausibility"]["gradient_median"] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("family", "said", "reason"),
    [
        ("neus", {"positional_encoding": {"degree": 20}}, "SETTINGS_CONTRADICT_TENSORS"),
        ("neus", {"input_scale": 1.0, "output_column": 300}, "SETTINGS_CONTRADICT_TENSORS"),
        ("idr, volsdf", {"positional_encoding": {"degree": 20}}, "SETTINGS_CONTRADICT_TENSORS"),
        ("siren", {"activation_scale": 30.0, "output_column": 1}, "SETTINGS_CONTRADICT_TENSORS"),
        ("plain_network", {"positional_encoding": {"degree": 20}}, "SETTINGS_CONTRADICT_TENSORS"),
        ("neus", {"level_mask": 3}, "INVALID_DESCRIPTION"),
        ("siren", {"activation": "relu", "activation_scale": 3.0}, "INVALID_DESCRIPTION"),
        ("siren", {"activation": "leaky_relu", "activation_scale": 3.0}, "INVALID_DESCRIPTION"),
        ("neus", {"first_activation_scale": 3.0}, "INVALID_DESCRIPTION"),
        ("neus", {"input_scale": 1.0, "output_tanh": 1, "output_bias": 1.0}, "INVALID_DESCRIPTION"),
        ("igr", {"family": "neus"}, "FAMILY_NOT_SUPPORTED"),
        ("idr, volsdf", {"family": "neus"}, "FAMILY_NOT_SUPPORTED"),
        ("plain_network", {"family": "siren"}, "FAMILY_NOT_SUPPORTED"),
    ],
)
def test_what_the_tensors_exclude_is_refused(family: str, said: dict[str, Any], reason: str, tmp_path: Path) -> None:
    case = case_of(family, 0)
    assert judged(case, case.beside | said, tmp_path).refused == reason


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"a.weight": torch.ones(4, 5), "b.weight": torch.ones(1, 4)}, "FIELD_NOT_RECOGNIZED"),
        ({"a.weight": torch.ones(4, 3), "b.weight": torch.ones(1, 5)}, "FIELD_NOT_RECOGNIZED"),
        ({"a.weight": torch.ones(4, 3), "n.weight": torch.ones(4), "b.weight": ONE_OUT}, "FIELD_NOT_RECOGNIZED"),
        (
            {
                "one": {"a.weight": torch.ones(4, 3), "b.weight": torch.ones(1, 4)},
                "two": {"a.weight": torch.ones(4, 3), "b.weight": torch.ones(1, 4)},
            },
            "FIELD_NOT_RECOGNIZED",
        ),
        ({"a.weight": torch.full((4, 3), torch.nan), "b.weight": torch.ones(1, 4)}, "TENSOR_NOT_FINITE"),
        ({f"{i}.weight": torch.ones(3, 3) for i in range(40)}, "FIELD_NOT_RECOGNIZED"),
    ],
)  # fmt: skip
def test_layers_that_are_no_network_of_positions(values: dict[str, Any], reason: str, tmp_path: Path) -> None:
    torch.save(values, tmp_path / "upload")
    with pytest.raises(FieldFormatError) as caught:
        convert_file(tmp_path / "upload", tmp_path, None, ImportLimits())
    assert caught.value.reason == reason


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(("kernel", "bias"), [("dense_{}.kernel", "dense_{}.bias"), ("w{}", "b{}")])
def test_layers_in_arrays(turned: bool, kernel: str, bias: str, tmp_path: Path) -> None:
    """As Flax has them (in, out), or as torch (out, in); twelve layers, so that 10 stands before 2 in the alphabet."""
    rng = np.random.default_rng(3)
    sizes = [3, *[16] * 11, 1]
    weights = [rng.normal(size=size).astype(np.float32) / 3.0 for size in zip(sizes[1:], sizes[:-1], strict=True)]
    biases = [0.1 * rng.normal(size=rows).astype(np.float32) for rows in sizes[1:]]

    def function(x: np.ndarray[Any, Any]) -> float:
        h = x
        for weight, b in zip(weights[:-1], biases[:-1], strict=True):
            h = np.tanh(weight.astype(float) @ h + b)
        return float((weights[-1].astype(float) @ h + biases[-1])[0])

    biases[-1] -= np.float32(np.median([function(x) for x in rng.uniform(-1.0, 1.0, (200, 3))]))
    stored = {kernel.format(i): weight if turned else weight.T for i, weight in enumerate(weights)}
    stored |= {bias.format(i): b for i, b in enumerate(biases)}
    with (tmp_path / "upload.npz").open("wb") as file:
        np.savez(file, **stored)  # type: ignore[arg-type]
    said = {"activation": "tanh", "output_tanh": 0}
    report = convert_file(tmp_path / "upload.npz", tmp_path, said, ImportLimits())
    assert report["family"] == "plain_network"
    points = rng.uniform(-1.0, 1.0, (40, 3)).astype(np.float32)
    found = open_field(tmp_path / FIELD_NAME).signed_distance(torch.from_numpy(points))
    expected = np.array([function(x) for x in points.astype(float)])
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-5 * np.ptp(expected))


@pytest.mark.long
@pytest.mark.parametrize("number", range(2))
@pytest.mark.parametrize("family", FAMILIES)
def test_a_trained_network_is_never_silently_wrong(family: str, number: int, tmp_path: Path) -> None:
    case = case_of(family, number, steps=150)
    found = judged(case, case.beside, tmp_path)
    assert found.refused in (None, "LAYOUT_AMBIGUOUS"), found.detail
    assert found.value < 1e-3


@pytest.mark.long
def test_a_siren_tells_its_factor(tmp_path: Path) -> None:
    case = case_of("siren", 5, steps=250)
    found = judged(case, {}, tmp_path)
    assert found.refused is None, found.detail
    assert found.value < 1e-5
