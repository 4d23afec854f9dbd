"""DeepSDF in blocks ``net.*.0``: against a slow evaluation in float64, at every place of the layer that narrows."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.core.importing.networks import slow_network as slow
from tests.core.importing.networks.cases import Case
from tests.core.importing.networks.judging import judged
from tests.core.importing.networks.trained import split

LATENT, HIDDEN, BLOCKS = 5, 24, 5


def case(place: int) -> Case:
    generator = torch.Generator().manual_seed(place)
    widths = {f"net.{i}.0": (HIDDEN, LATENT + 3 if i == 0 else HIDDEN) for i in range(BLOCKS)}
    widths |= {"skip_layer.0": (HIDDEN - LATENT - 3, HIDDEN), "final_layer.0": (1, HIDDEN)}
    state: dict[str, Any] = {}
    for name, (rows, columns) in widths.items():
        state[f"{name}.bias"] = 0.1 * torch.randn(rows, generator=generator)
        state[f"{name}.weight"] = torch.randn(rows, columns, generator=generator) * math.sqrt(2.0 / columns)
    code = torch.randn(LATENT, generator=generator).tolist()
    saved = split(state, [f"net.{i}.0" for i in range(BLOCKS)])

    def function(x: Any) -> float:
        given = h = np.concatenate((np.array(code, dtype=np.float32), x))
        for i in range(BLOCKS):
            if i == place and place:
                h = np.concatenate((np.maximum(slow.linear(saved, "skip_layer.0", h), 0.0), given))
            h = np.maximum(slow.linear(saved, f"net.{i}.0", h), 0.0)
        return math.tanh(slow.linear(saved, "final_layer.0", h)[0])

    points = np.random.default_rng(1).uniform(-1.0, 1.0, (101, 3))
    saved["final_layer.0.bias"] -= float(np.median([math.atanh(function(point)) for point in points]))
    return Case(dict(saved), {"skip_layer": place}, {"latent": code}, function, "")


@pytest.mark.parametrize("place", [0, 1, 3])
def test_evaluated_as_said(place: int, tmp_path: Path) -> None:
    made = case(place)
    found = judged(made, made.said | made.beside, tmp_path)
    assert found.refused is None, found.detail
    assert found.value < 1e-5
    assert found.gradient < 1e-3


@pytest.mark.parametrize(
    ("said", "reason"),
    [({}, "LAYOUT_AMBIGUOUS"), ({"skip_layer": 30}, "INVALID_DESCRIPTION"), ({"latent": [1.0]}, "INVALID_DESCRIPTION")],
)
def test_what_is_left_open_or_does_not_fit(said: dict[str, Any], reason: str, tmp_path: Path) -> None:
    made = case(3)
    assert judged(made, made.beside | said, tmp_path).refused == reason


def test_without_a_latent_code(tmp_path: Path) -> None:
    assert judged(case(3), {}, tmp_path).refused == "LATENT_MISSING"
