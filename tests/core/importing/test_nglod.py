"""NGLOD: against torch's own grid_sample, as the trainer calls it, in double precision."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from tests.core.importing.archives import assert_refused

LEVELS, FEATURES, HIDDEN = 3, 8, 16


def checkpoint() -> dict[str, Tensor]:
    """A state dictionary with three levels of detail, random."""
    generator = torch.Generator().manual_seed(2)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    state = {}
    for i in range(LEVELS):
        nodes = 2 ** (i + 2) + 1
        state[f"features.{i}.fm"] = normal(1, FEATURES, nodes, nodes, nodes)
        state[f"louts.{i}.0.weight"] = normal(HIDDEN, 3 + FEATURES) / 3
        state[f"louts.{i}.0.bias"] = normal(HIDDEN) / 3
        state[f"louts.{i}.2.weight"] = normal(1, HIDDEN) / 4
        state[f"louts.{i}.2.bias"] = torch.zeros(1)
    return state


def evaluate(state: dict[str, Tensor], points: Tensor, levels: int) -> Tensor:
    """The network at points (N, 3) in [-1, 1]^3, float64, differentiable."""
    grid = points[None, :, None, None]  # grid_sample has x, y, z point into the last, middle and first axis
    features = torch.zeros(len(points), FEATURES, dtype=torch.float64)
    for i in range(levels):
        volume = state[f"features.{i}.fm"].double()
        sampled = torch.nn.functional.grid_sample(volume, grid, align_corners=True, padding_mode="border")
        features = features + sampled[0, :, :, 0, 0].T
    lout = {name: state[f"louts.{levels - 1}.{name}"].double() for name in ("0.weight", "0.bias", "2.weight", "2.bias")}
    hidden = torch.relu(torch.cat((points, features), -1) @ lout["0.weight"].T + lout["0.bias"])
    return (hidden @ lout["2.weight"].T + lout["2.bias"])[:, 0]


def converted(folder: Path, state: dict[str, Any], overrides: dict[str, Any] | None = None) -> dict[str, Any]:
    """Random numbers are no distance, and may be matter all round: that is accepted."""
    torch.save(state, folder / "sdf.pth")
    return convert_file(folder / "sdf.pth", folder, {"accept_implausible": True, **(overrides or {})}, ImportLimits())


@pytest.mark.parametrize("levels", [None, 2, 1])
def test_values_and_gradients(tmp_path: Path, levels: int | None) -> None:
    state = checkpoint()
    report = converted(tmp_path, state, None if levels is None else {"level_mask": levels})
    assert report["family"] == "nglod"
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 2 - 1
    leaf = points.clone().requires_grad_()
    expected = evaluate(state, leaf, levels or LEVELS)
    (slope,) = torch.autograd.grad(expected.sum(), leaf)
    field = open_field(tmp_path / FIELD_NAME)
    distance, gradient = field.signed_distance_and_gradient(points)
    values = expected.detach().numpy()
    np.testing.assert_allclose(distance.numpy(), values, rtol=0, atol=1e-5 * np.ptp(values))
    off = (gradient - slope.float()).abs().amax(-1) > 1e-3
    assert float(off.float().mean()) <= 0.01  # a unit of the network may switch within rounding
    torch.testing.assert_close(field.to("cpu").signed_distance(points), distance, rtol=0, atol=1e-5)


def test_beyond_the_cube_it_is_carried_on(tmp_path: Path) -> None:
    converted(tmp_path, checkpoint())
    field = open_field(tmp_path / FIELD_NAME)
    inside, outside = (
        torch.tensor([[1.0, 0.3, -0.2], [1.0, 1.0, 1.0]]),
        torch.tensor([[1.5, 0.3, -0.2], [2.0, 2.0, 2.0]]),
    )
    way = (outside - inside).norm(dim=-1)
    torch.testing.assert_close(field.signed_distance(outside), field.signed_distance(inside) + way)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda state: state.update({"features.1.fm": torch.zeros(1, FEATURES, 9, 9, 8)}), "TENSOR_SHAPE"),
        (lambda state: state.update({"features.1.fm": torch.zeros(1, FEATURES + 1, 9, 9, 9)}), "TENSOR_SHAPE"),
        (lambda state: state.update({"features.1.fm": torch.zeros(FEATURES, 9, 9)}), "TENSOR_SHAPE"),
        (lambda state: state.update({"louts.2.2.weight": torch.zeros(1, 3)}), "TENSOR_SHAPE"),
        (lambda state: state.pop("features.1.fm"), "TENSOR_MISSING"),
        (lambda state: state.pop("louts.2.0.bias"), "TENSOR_MISSING"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, change: Any, reason: str) -> None:
    state = checkpoint()
    change(state)
    assert_refused(lambda: converted(tmp_path, state), reason)


def test_more_levels_than_there_are_cannot_be_asked_for(tmp_path: Path) -> None:
    assert_refused(lambda: converted(tmp_path, checkpoint(), {"level_mask": 4}), "INVALID_DESCRIPTION")
