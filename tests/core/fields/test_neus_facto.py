"""Whole fields: against a slow evaluation in float64, and against values computed by the trainers' own code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.fields.neus_facto import NeusFactoField, build_neus_facto
from regnf_core.fields.observation import SdfField
from regnf_core.schema.safe_format import parse_description
from tests.core.fields.reference import central_differences, field_slowly
from tests.core.fields.small_field import GRID, description, tensors
from tests.devdata import dev_data


def small_field(layers: int = 3, **changes: Any) -> NeusFactoField:
    parameters = {name: torch.from_numpy(array) for name, array in tensors(layers).items()}
    return build_neus_facto(parse_description(description(**changes)), parameters)


def some_points(count: int = 10) -> NDArray[np.float32]:
    # Up to the scene's [-1, 1], then beyond it, where contraction acts and the raw grid wraps round.
    rng = np.random.default_rng(2)
    return np.concatenate((rng.uniform(-1, 1, (count, 3)), rng.uniform(-2.6, 2.6, (count, 3)))).astype(np.float32)


@pytest.mark.parametrize("layers", [1, 3, 6])
@pytest.mark.parametrize(
    ("contraction", "two_pi"), [("none", False), ("linf", False), ("linf_grid", True), ("linf", True)]
)
def test_agrees_with_a_slow_evaluation(layers: int, contraction: str, two_pi: bool) -> None:
    encoding = {"degree": 6, "two_pi": two_pi}
    field = small_field(layers, contraction=contraction, positional_encoding=encoding)
    points = some_points()

    def slowly(point: NDArray[Any]) -> float:
        return field_slowly(GRID, tensors(layers), point, two_pi=two_pi, contraction=contraction)

    distance, gradient = field.signed_distance_and_gradient(torch.from_numpy(points))
    np.testing.assert_allclose(distance.numpy(), [slowly(p.astype(np.float64)) for p in points], atol=2e-4)
    expected = np.stack([central_differences(slowly, p.astype(np.float64), step=1e-7) for p in points])
    np.testing.assert_allclose(gradient.numpy(), expected, atol=1e-3 * np.abs(expected).max())
    torch.testing.assert_close(field.signed_distance(torch.from_numpy(points)), distance, rtol=0, atol=2e-6)


def test_is_an_sdf_field_without_a_graph() -> None:
    field = small_field()
    assert isinstance(field, SdfField)
    assert field.bounds.dtype == torch.float64
    points = torch.zeros(5, 3, dtype=torch.float64, requires_grad=True)
    distance, gradient = field.signed_distance_and_gradient(points)
    assert distance.dtype == gradient.dtype == torch.float32
    assert not distance.requires_grad
    assert not gradient.requires_grad
    moved = field.to("cpu")
    torch.testing.assert_close(moved.signed_distance(points.detach()), distance)


def test_chunks_change_nothing() -> None:
    field = small_field()
    points = torch.from_numpy(some_points(500))
    whole = NeusFactoField(field.function, field.bounds, chunk=1 << 20)
    parted = NeusFactoField(field.function, field.bounds, chunk=64)
    for a, b in zip(
        whole.signed_distance_and_gradient(points), parted.signed_distance_and_gradient(points), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-6)
    assert parted.signed_distance(points).shape == (1000,)
    distance, gradient = parted.signed_distance_and_gradient(points[:0])
    assert parted.signed_distance(points[:0]).shape == distance.shape == (0,)
    assert gradient.shape == (0, 3)


def test_masked_levels_count_as_zeros() -> None:
    parameters = {name: torch.from_numpy(array) for name, array in tensors(6).items()}
    parameters["hash_table"][sum(GRID.level_entries()[:2]) :] = 0.0
    expected = build_neus_facto(parse_description(description()), parameters)
    points = torch.from_numpy(some_points())
    masked = small_field(6, level_mask=2)
    torch.testing.assert_close(masked.signed_distance(points), expected.signed_distance(points), rtol=0, atol=2e-6)


def test_unused_encodings_count_as_zeros() -> None:
    # With a table of zeros the grid's features are zero; the first three columns and the sines remain.
    zeroed = {name: torch.from_numpy(array) for name, array in tensors(6).items()}
    points, table = torch.from_numpy(some_points()), zeroed["hash_table"].zero_()
    with_zeros = build_neus_facto(parse_description(description()), {**zeroed, "hash_table": table})
    del zeroed["hash_table"]
    without = build_neus_facto(parse_description(description(use_grid=False)), zeroed)
    assert without.function.hash_encoding is None
    torch.testing.assert_close(without.signed_distance(points), with_zeros.signed_distance(points), rtol=0, atol=2e-6)


def stored_field(family: str, contraction: str) -> tuple[Path, NeusFactoField]:
    """The field of a reference checkpoint. These files are our own, so plain unpickling is safe."""
    folder = dev_data("formats", family)
    meta = json.loads((folder / "meta.json").read_text())
    checkpoint = next(folder.glob("outputs/**/*.ckpt"))
    state = torch.load(checkpoint, map_location="cpu", weights_only=False)["pipeline"]
    state = {name.removeprefix("_model.field."): tensor for name, tensor in state.items()}
    grid, hyper = meta["grid"], meta["hyper_parameters"]
    uses_grid = meta.get("grid_is_used", True)
    parameters: dict[str, Tensor] = {}
    for i in range(sum(name.startswith("glin") and name.endswith("bias") for name in state)):
        v, g = state[f"glin{i}.weight_v"], state[f"glin{i}.weight_g"]
        parameters[f"layers.{i}.weight"] = g * v / v.norm(dim=1, keepdim=True)
        parameters[f"layers.{i}.bias"] = state[f"glin{i}.bias"]
    if uses_grid:
        parameters["hash_table"] = state["encoding.params"].view(-1, grid["features_per_level"])
    names = {
        "levels": "n_levels",
        "features_per_level": "features_per_level",
        "log2_table_size": "log2_hashmap_size",
        "base_resolution": "base_resolution",
        "per_level_scale": "per_level_scale",
    }
    used = hyper.get("use_position_encoding", True)
    values = description(
        hash={ours: grid[theirs] for ours, theirs in names.items()} | {"interpolation": grid["interpolation"].lower()},
        positional_encoding={"degree": 6, "two_pi": family.startswith("nerfstudio"), "used": used},
        use_grid=uses_grid,
        contraction=contraction,
    )
    return folder, build_neus_facto(parse_description(values), parameters)


RAW = ("none", "sdf", "gradient")
CONTRACTED = ("linf", "sdf_contracted", "gradient_contracted_wrt_input")


@pytest.mark.parametrize(
    ("family", "contraction", "values", "gradients"),
    [
        *(("sdfstudio_neus_facto", *RAW), ("sdfstudio_neus_facto", *CONTRACTED)),
        *(("sdfstudio_neus_facto_angelo", *RAW), ("sdfstudio_neus_facto_angelo", *CONTRACTED)),
        *(("sdfstudio_neus", *RAW), ("sdfstudio_neus", *CONTRACTED)),
        ("nerfstudio_neus_facto", "linf_grid", "sdf", "gradient"),
    ],
)
def test_agrees_with_the_trainer(family: str, contraction: str, values: str, gradients: str) -> None:
    folder, field = stored_field(family, contraction)
    points = torch.from_numpy(np.load(folder / "points.npy"))
    expected = torch.from_numpy(np.load(folder / f"{values}.npy")).reshape(-1)
    slopes = torch.from_numpy(np.load(folder / f"{gradients}.npy"))
    distance, gradient = field.signed_distance_and_gradient(points)
    extent = float(expected.max() - expected.min())
    torch.testing.assert_close(field.signed_distance(points), expected, rtol=0, atol=1e-5 * extent)
    torch.testing.assert_close(distance, expected, rtol=0, atol=1e-5 * extent)
    torch.testing.assert_close(gradient, slopes, rtol=0, atol=1e-3)


@pytest.mark.parametrize("family", ["sdfstudio_neus_facto", "sdfstudio_neus_facto_angelo", "nerfstudio_neus_facto"])
def test_features_agree_with_the_trainer(family: str) -> None:
    folder, field = stored_field(family, "none")
    encoding = field.function.hash_encoding
    assert encoding is not None
    features = encoding.encode(torch.from_numpy(np.load(folder / "hash_input.npy")))
    np.testing.assert_allclose(features.numpy(), np.load(folder / "hash_output.npy"), atol=1e-6)
