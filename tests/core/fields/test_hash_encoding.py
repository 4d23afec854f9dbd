"""The hash encoding against the original kernel's output, and against a slow loop over the formulas."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.schema.hash_grid_config import HashGridConfig, Interpolation
from tests.core.fields.reference import central_differences, encode_slowly
from tests.core.importing.archives import assert_refused
from tests.devdata import dev_data

GRID = HashGridConfig.from_top_resolution(40, levels=4, log2_table_size=9, base_resolution=5)


def random_encoding(config: HashGridConfig, **arguments: Any) -> HashEncoding:
    generator = torch.Generator().manual_seed(3)
    return HashEncoding(
        config, torch.randn(config.entries, config.features_per_level, generator=generator), **arguments
    )


def points_in_and_outside(count: int = 40) -> np.ndarray[Any, np.dtype[np.float32]]:
    rng = np.random.default_rng(11)
    inside = rng.uniform(0, 1, (count, 3))
    outside = rng.uniform(-1.5, 2.5, (count, 3))
    edges = rng.integers(0, 2, (8, 3))
    return np.concatenate((inside, outside, edges)).astype(np.float32)


@pytest.mark.parametrize("features", [1, 2, 3, 4, 8])
@pytest.mark.parametrize("interpolation", ["linear", "smoothstep"])
def test_agrees_with_a_slow_loop(features: int, interpolation: Interpolation) -> None:
    config = replace(GRID, features_per_level=features, interpolation=interpolation)
    assert set(config.level_is_dense()) == {True, False}
    encoding = random_encoding(config)
    points = points_in_and_outside()
    slow = np.stack([encode_slowly(config, encoding.table.numpy(), p.astype(np.float64)) for p in points])
    fast = encoding.encode(torch.from_numpy(points)).numpy()
    # Linear interpolation turns a rounding error of the position (float32, up to 100 cells from the origin) into one of
    # the feature.
    np.testing.assert_allclose(fast, slow, atol=5e-5)


@pytest.mark.parametrize("interpolation", ["linear", "smoothstep"])
def test_derivative_agrees_with_finite_differences(interpolation: Interpolation) -> None:
    config = replace(GRID, interpolation=interpolation)
    encoding = random_encoding(config)
    points = points_in_and_outside()[:60]
    features, derivative = encoding.encode_with_derivative(torch.from_numpy(points))
    assert torch.equal(features, encoding.encode(torch.from_numpy(points)))
    for i, point in enumerate(points.astype(np.float64)):
        slow = central_differences(lambda p: encode_slowly(config, encoding.table.numpy(), p), point)
        np.testing.assert_allclose(derivative[:, i].T.numpy(), slow, atol=5e-3)


@pytest.mark.parametrize("case", range(4))
def test_agrees_with_the_original_kernel(case: int) -> None:
    meta = json.loads(dev_data("formats", "tcnn_hashgrid", "meta.json").read_text())["cases"][case]
    data = np.load(dev_data("formats", "tcnn_hashgrid", meta["file"]))
    config = HashGridConfig(
        levels=meta["n_levels"],
        features_per_level=meta["n_features_per_level"],
        log2_table_size=meta["log2_hashmap_size"],
        base_resolution=meta["base_resolution"],
        per_level_scale=meta["per_level_scale"],
        interpolation=meta["interpolation"].lower(),
    )
    assert config.scales() == tuple(data["scale"].tolist())
    assert config.level_resolutions() == tuple(data["resolution"].tolist())
    assert np.cumsum(config.level_entries()).tolist() == data["offsets"][1:].tolist()
    encoding = HashEncoding(config, torch.from_numpy(data["params"]).view(-1, config.features_per_level))
    features, derivative = encoding.encode_with_derivative(torch.from_numpy(data["u"]))
    np.testing.assert_allclose(features.numpy(), data["encoding"], atol=1e-6)
    smooth = ~data["near_cell_border"]
    np.testing.assert_allclose(
        derivative.permute(1, 2, 0).numpy()[smooth], data["d_encoding_d_u"][smooth], rtol=1e-5, atol=1e-3
    )


def test_active_levels_are_the_coarsest() -> None:
    points = torch.from_numpy(points_in_and_outside())
    whole, masked = random_encoding(GRID), random_encoding(GRID, active_levels=3)
    assert masked.width == 6
    torch.testing.assert_close(masked.encode(points), whole.encode(points)[:, :6])


@pytest.mark.parametrize("features", [2, 3])
def test_gradient_with_respect_to_the_table(features: int) -> None:
    # The encoding is linear in the table, so <g, encode(t)> = <gradient, t>.
    encoding = random_encoding(replace(GRID, features_per_level=features))
    encoding.table.requires_grad_()
    values, derivative = encoding.encode_with_derivative(torch.from_numpy(points_in_and_outside()))
    generator = torch.Generator().manual_seed(5)
    weights = [torch.randn(v.shape, generator=generator) for v in (values, derivative)]
    total = (values * weights[0]).sum() + (derivative * weights[1]).sum()
    total.backward()  # type: ignore[no-untyped-call]
    assert encoding.table.grad is not None
    torch.testing.assert_close((encoding.table.grad * encoding.table).sum(), total, rtol=1e-4, atol=1e-2)


def test_no_points() -> None:
    features, derivative = random_encoding(GRID).encode_with_derivative(torch.zeros(0, 3))
    assert features.shape == (0, 8)
    assert derivative.shape == (3, 0, 8)


def test_points_that_are_no_numbers_read_nothing_outside_the_table() -> None:
    odd = torch.tensor([[torch.nan, 0.5, 0.5], [torch.inf, 0.5, 0.5], [-3e38, 3e38, 0.0]])
    assert random_encoding(GRID).encode(odd).shape == (3, 8)


def test_wrong_table_is_refused() -> None:
    assert_refused(lambda: HashEncoding(GRID, torch.zeros(GRID.entries + 8, 2)), "FIELD_SHAPES_MISMATCH")
