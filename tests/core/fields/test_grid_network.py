"""The kind grid_network: its one-blob encoding against integrals, its gradients against differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import build_field
from regnf_core.fields.grid_mlp import OneBlob
from regnf_core.schema.safe_format import parse_description
from regnf_core.schema.tensor_check import TensorSpec

GRID = {"levels": 3, "features_per_level": 2, "log2_table_size": 9, "base_resolution": 4, "per_level_scale": 2.0}
ENTRIES = 64 + 512 + 512
BOX = [[-1.0, -2.0, 0.5], [1.0, 1.0, 4.0]]


def share_of_bins(x: float, bins: int) -> np.ndarray:
    """By sums over a fine division of the ring: what of the bump about x falls into each bin."""
    fine = (np.arange(bins * 4000) + 0.5) / (bins * 4000)
    away = (fine - x + 0.5) % 1.0 - 0.5
    bump = 15 / 16 * np.clip(1 - (bins * away) ** 2, 0, None) ** 2 / 4000
    return np.asarray(bump.reshape(bins, -1).sum(axis=1))


@pytest.mark.parametrize("bins", [2, 5, 16])
def test_the_one_blob_encoding_is_the_integral_of_its_bump(bins: int) -> None:
    points = np.random.default_rng(bins).uniform(0, 1, (20, 3))
    points[0] = (0.0, 0.5, 1.0)
    encoded = OneBlob(bins).encode(torch.tensor(points))
    assert encoded.shape == (20, 3 * bins)
    for point, row in zip(points, encoded, strict=True):
        expected = np.concatenate([share_of_bins(x, bins) for x in point])
        assert np.abs(row.numpy() - expected).max() < 1e-6
        assert float(row.sum()) == pytest.approx(3.0)


def test_the_one_blob_encoding_s_gradient() -> None:
    at = torch.rand(30, 3, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(30, 24, dtype=torch.float64)
    (expected,) = torch.autograd.grad((OneBlob(8).encode(at) * weights).sum(), at)
    assert torch.allclose(OneBlob(8).pull_back(at.detach(), weights), expected)


def described(**changed: Any) -> dict[str, Any]:
    values = {"kind": "grid_network", "bounds": BOX, "hash": GRID, "grid_box": BOX, "one_blob_bins": 4}
    return values | {"positional_encoding": {"degree": 2}, "skip_layer": 2} | changed


def tensors(width: int, skip: int | None) -> dict[str, torch.Tensor]:
    source = torch.Generator().manual_seed(1)
    inputs = [width, 16, 16 + (width if skip == 2 else 0)]
    made = {"hash_table": torch.randn(ENTRIES, 2, generator=source)}
    for i, (columns, rows) in enumerate(zip(inputs, (16, 16, 1), strict=True)):
        made[f"layers.{i}.weight"] = torch.randn(rows, columns, generator=source) / columns**0.5
        made[f"layers.{i}.bias"] = torch.randn(rows, generator=source)
    return made


@pytest.mark.parametrize(
    ("changed", "width", "skip"),
    [({}, 33, 2), ({"one_blob_bins": 0, "activation": "relu"}, 21, 2), ({"skip_layer": None}, 33, None)],
)
def test_gradients(changed: dict[str, Any], width: int, skip: int | None) -> None:
    """Within the box, where it ends, and beyond it, where the field is carried on."""
    field = build_field(parse_description(described(**changed)), tensors(width, skip))
    points = torch.tensor(np.random.default_rng(2).uniform([-1.5, -2.5, 0], [1.5, 1.5, 4.5], (60, 3))).float()
    values, gradients = field.signed_distance_and_gradient(points)
    assert torch.allclose(values, field.signed_distance(points), atol=1e-5)
    steps = 1e-3 * torch.eye(3)
    slopes = [(field.signed_distance(points + step) - field.signed_distance(points - step)) / 2e-3 for step in steps]
    apart = (torch.stack(slopes, dim=1) - gradients).norm(dim=1)
    assert (apart < 0.02 * (1 + gradients.norm(dim=1))).float().mean() > 0.9  # the others cross a kink


@pytest.mark.parametrize(
    "changed",
    [{"skip_layer": 3}, {"grid_box": [[0.0, 0.0, 0.0], [1.0, 0.0, 1.0]]}, {"one_blob_bins": 5}, {"hash": {}}],
)
def test_what_does_not_fit_is_refused(changed: dict[str, Any]) -> None:
    specs = {name: TensorSpec(tuple(value.shape), "F32") for name, value in tensors(33, 2).items()}
    parse_description(described()).check(specs)
    with pytest.raises(FieldFormatError) as caught:
        parse_description(described(**changed)).check(specs)
    assert caught.value.reason == "FIELD_SHAPES_MISMATCH"
