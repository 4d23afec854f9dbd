"""A color never makes an import fail: what is not understood is left out, with a warning, and only the geometry is
imported."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.fields.build import build_field
from regnf_core.fields.observation import has_color
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.gate.cost_estimate import with_affordable_color
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.schema.safe_format import parse_description
from tests.core.importing import small_families as small
from tests.core.importing.checkpoints import checkpoint
from tests.core.importing.test_families import ANGELO_GRID
from tests.core.importing.test_reference_checkpoints import SAID
from tests.core.importing.test_sdfstudio import F, convert

Change = Callable[[dict[str, Any]], object]


def with_tensor(name: str, value: torch.Tensor) -> Change:
    return lambda pipeline: pipeline.update({F + name: value})


CHANGES: dict[str, Change] = {
    "a part is missing": lambda pipeline: pipeline.pop(F + "clin0.weight_g"),
    "a layer is missing": lambda state: [state.pop(F + f"clin0.{part}") for part in ("bias", "weight_g", "weight_v")],
    "other columns": with_tensor("clin0.weight_v", torch.ones(8, 130)),
    "four results": with_tensor("clin1.weight_v", torch.ones(4, 8)),
    "not finite": with_tensor("clin1.bias", torch.full((3,), torch.nan)),
    "another head": with_tensor("diffuse_color_pred.weight", torch.ones(3, 64)),
    "no tensor": lambda pipeline: pipeline.update({F + "clin0.bias": "text"}),
    "columns of no direction": with_tensor("embedding_appearance.embedding.weight", torch.ones(5, 31)),
}
LAYOUT = SAID | {"hash": SAID["hash"] | {"features_per_level": 2}}


@cache
def whole() -> ConvertedField:
    """With its color."""
    return convert(checkpoint(), **LAYOUT)


def built(converted: ConvertedField) -> Any:
    tensors = {name: torch.from_numpy(np.array(array)) for name, array in converted.tensors.items()}
    return build_field(parse_description(converted.description), tensors)


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_color_that_is_not_understood_is_left_out(change: Change) -> None:
    values = checkpoint()
    change(values["pipeline"])
    converted = convert(values, **LAYOUT)
    assert [warning.partition(":")[0] for warning in converted.warnings] == ["COLOR_LEFT_OUT"]
    assert "color" not in converted.description
    assert not has_color(built(converted))
    assert has_color(built(whole()))
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    assert torch.equal(built(converted).signed_distance(points), built(whole()).signed_distance(points))


def test_a_checkpoint_without_color_is_nothing_to_warn_of() -> None:
    values = checkpoint()
    for name in [name for name in values["pipeline"] if ".clin" in name]:
        del values["pipeline"][name]
    converted = convert(values, **LAYOUT)
    assert converted.warnings == ()
    assert not has_color(built(converted))
    assert built(converted).inverse_deviation == pytest.approx(np.exp(3.0), rel=1e-6)


def test_an_appearance_of_which_nothing_is_said_is_told() -> None:
    (warning,) = whole().warnings
    assert warning.startswith("COLOR_ASSUMED: ")
    assert "color.average_appearance: true" in warning  # what to say
    for said in (True, False):
        assert convert(checkpoint(), **LAYOUT, color={"average_appearance": said}).warnings == ()
    assert convert(checkpoint(), **LAYOUT, color={"keep": False}).warnings == ()


@pytest.mark.parametrize(("keep", "words"), [(None, ["COLOR_LEFT_OUT"]), (False, [])])
def test_a_color_of_a_family_whose_colors_are_not_read_is_told(keep: bool | None, words: list[str]) -> None:
    def told() -> list[str]:
        warnings = convert(values, **ANGELO_GRID, color={"keep": keep}).warnings
        return [word for word in (warning.partition(":")[0] for warning in warnings) if word.startswith("COLOR")]

    values = small.neuralangelo(20_000).checkpoint
    assert told() == []
    values["model"]["module.neural_rgb.mlp.linears.0.weight"] = torch.ones(3, 8)
    assert told() == words


def test_all_readings_have_the_color() -> None:
    converted = convert(checkpoint())
    assert len(converted.readings) > 1
    assert all("color.layers.0.weight" in reading.tensors for reading in converted.readings)
    assert all("color" in reading.description for reading in converted.readings)


def test_a_color_that_takes_too_long_is_left_out() -> None:
    converted = whole()
    costly = with_affordable_color(converted, ImportLimits(work_s=0.1))
    assert [warning.partition(":")[0] for warning in costly.warnings] == ["COLOR_LEFT_OUT"]
    assert not has_color(built(costly))
    assert with_affordable_color(converted, ImportLimits()) is converted


def test_numbers_of_any_size_give_a_color() -> None:
    values = checkpoint()
    values["pipeline"][F + "clin0.weight_g"] *= 1e30
    values["pipeline"][F + "clin1.weight_g"] *= 1e30
    field = built(convert(values, **LAYOUT))
    points, directions = torch.rand(2, 100, 3, generator=torch.Generator().manual_seed(0))
    color = field.color(points, torch.nn.functional.normalize(directions, dim=-1))
    assert bool(((color >= 0.0) & (color <= 1.0)).all())
