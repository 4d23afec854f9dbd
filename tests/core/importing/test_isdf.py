"""iSDF: against a slow evaluation in float64, straight from the formulas."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from regnf_core.fields.build import open_field
from regnf_core.fields.color_head import _ICOSAHEDRON
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from tests.core.fields.grids import numeric_gradient
from tests.core.importing.archives import assert_refused

Array = NDArray[Any]
WIDTH, FREQUENCIES = 16, 2
INPUTS = 3 + 2 * 21 * FREQUENCIES
USUAL = (0.05937489, 0.14)
BOUNDS = [[-3.0, -3.0, -2.0], [3.0, 3.0, 2.0]]


def checkpoint(blocks: int = 1) -> dict[str, Any]:
    """A checkpoint with ``blocks`` layers in each of the two blocks, random."""
    generator = torch.Generator().manual_seed(4)
    widths = {"in_layer.0": INPUTS, "cat_layer.0": WIDTH + INPUTS, "out_alpha": WIDTH}
    widths |= {f"{block}.{i}.0": WIDTH for block in ("mid1", "mid2") for i in range(blocks)}
    state = {}
    for name, columns in widths.items():
        rows = 1 if name == "out_alpha" else WIDTH
        state[f"{name}.weight"] = 2.0 * torch.randn(rows, columns, generator=generator) / columns**0.5
        state[f"{name}.bias"] = 0.1 * torch.randn(rows, generator=generator)
    return {"step": 900, "model_state_dict": state, "optimizer_state_dict": {}, "loss": 0.1}


def evaluate(state: dict[str, Any], blocks: int, point: Array, scales: tuple[float, float]) -> float:
    weights = {name: tensor.numpy().astype(np.float64) for name, tensor in state.items()}

    def layer(name: str, h: Array) -> Array:
        a: Array = weights[f"{name}.weight"] @ h + weights[f"{name}.bias"]
        return a

    def softplus(a: Array) -> Array:
        return np.asarray(np.logaddexp(0.0, 100.0 * a) / 100.0)

    x = scales[0] * point
    angles = [2.0**k * (x @ direction) for direction in np.array(_ICOSAHEDRON) for k in range(FREQUENCIES)]
    inputs = np.concatenate((x, np.sin(angles), np.sin(np.array(angles) + np.pi / 2)))
    h = softplus(layer("in_layer.0", inputs))
    for i in range(blocks):
        h = softplus(layer(f"mid1.{i}.0", h))
    h = softplus(layer("cat_layer.0", np.concatenate((h, inputs))))
    for i in range(blocks):
        h = softplus(layer(f"mid2.{i}.0", h))
    return float(scales[1] * layer("out_alpha", h)[0])


def converted(folder: Path, values: dict[str, Any], overrides: dict[str, Any] | None = None) -> dict[str, Any]:
    torch.save(values, folder / "step_900.pth")
    return convert_file(folder / "step_900.pth", folder, overrides, ImportLimits())


RANDOM = {"accept_implausible": True}
"""Networks of random weights are no distances."""


@pytest.mark.parametrize("blocks", [0, 1, 2])
@pytest.mark.parametrize("scales", [USUAL, (0.4, 0.3)])
def test_values_and_gradients(tmp_path: Path, blocks: int, scales: tuple[float, float]) -> None:
    values = checkpoint(blocks)
    overrides = {"bounds": BOUNDS, "input_scale": scales[0], "output_scale": scales[1]} | RANDOM
    values["model_state_dict"]["out_alpha.bias"] -= evaluate(
        values["model_state_dict"], blocks, np.zeros(3), (1.0, 1.0)
    )  # a zero level through the middle
    report = converted(tmp_path, values, overrides)
    assert report["family"] == "isdf"
    assert "BOUNDS_ASSUMED" not in str(report["warnings"])
    points = np.random.default_rng(1).uniform(*BOUNDS, size=(40, 3))
    distance, gradient = open_field(tmp_path / FIELD_NAME).signed_distance_and_gradient(torch.from_numpy(points))

    def slow(point: Array) -> float:
        return evaluate(values["model_state_dict"], blocks, point, scales)

    expected = np.array([slow(point) for point in points])
    np.testing.assert_allclose(distance.numpy(), expected, rtol=0, atol=1e-5 * np.ptp(expected))
    slopes = np.array([numeric_gradient(slow, point, 1e-5) for point in points])
    np.testing.assert_allclose(gradient.numpy(), slopes, rtol=0, atol=1e-3 * np.abs(slopes).max())


def test_what_no_file_tells_is_said(tmp_path: Path) -> None:
    values = checkpoint()
    values["model_state_dict"]["out_alpha.bias"] -= evaluate(values["model_state_dict"], 1, np.zeros(3), (1.0, 1.0))
    assert_refused(lambda: converted(tmp_path, values), "LAYOUT_AMBIGUOUS")  # random: its gradient says nothing
    report = converted(tmp_path, values, {"input_scale": USUAL[0], "output_scale": USUAL[1]} | RANDOM)
    assert "BOUNDS_ASSUMED" in [warning.split(":")[0] for warning in report["warnings"]]
    assert "0.0593749" in " ".join(report["why"])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda state: state.update({"in_layer.0.weight": torch.zeros(WIDTH, INPUTS + 1)}), "TENSOR_SHAPE"),
        (lambda state: state.update({"cat_layer.0.weight": torch.zeros(WIDTH, WIDTH)}), "TENSOR_SHAPE"),
        (
            lambda state: state.update({"positional_encoding.B_layer.weight": torch.zeros(93, 3)}),
            "FAMILY_NOT_SUPPORTED",
        ),
        (lambda state: state.pop("cat_layer.0.weight"), "TENSOR_MISSING"),
        (lambda state: state.pop("mid2.0.0.bias"), "TENSOR_MISSING"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, change: Any, reason: str) -> None:
    values = checkpoint()
    change(values["model_state_dict"])
    assert_refused(lambda: converted(tmp_path, values), reason)
