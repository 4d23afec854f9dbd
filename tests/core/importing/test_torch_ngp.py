"""torch-ngp's fields of meshes, both encoders: against a slow evaluation in float64 straight from the formulas."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from regnf_core.fields.build import open_field
from regnf_core.fields.observation import SdfField
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.safe_format import read_description
from tests.core.fields.grids import numeric_gradient
from tests.core.fields.reference import encode_slowly
from tests.core.importing.archives import assert_refused

Array = NDArray[Any]
LEVELS, BASE, TOP, LOG2 = 4, 8, 128, 15
PRIMES = (1, 2654435761, 805459861)
TOP_TOLD = {"hash": {"top_resolution": TOP}}


def growth() -> float:
    return float(np.exp2(np.log2(TOP / BASE) / (LEVELS - 1)))


def level_sizes() -> list[int]:
    """Entries a level: a resolution's nodes and one more along an edge, in eights, at most 2^LOG2."""
    nodes = [math.ceil(BASE * growth() ** level) + 1 for level in range(LEVELS)]
    return [min(2**LOG2, math.ceil(n**3 / 8) * 8) for n in nodes]


def encode(table: Array, point: Array) -> Array:
    """Features of a point in [-1, 1]^3 as the trainer's own kernel computes them."""
    features: list[Array] = []
    start = 0
    for level, size in enumerate(level_sizes()):
        scale = 2.0 ** (level * math.log2(growth())) * BASE - 1.0
        stride = math.ceil(scale) + 2
        position = (point + 1.0) / 2.0 * scale + 0.5
        cell = np.floor(position)
        total = np.zeros(table.shape[1])
        for corner in itertools.product((0, 1), repeat=3):
            node = [int(c) + k for c, k in zip(cell, corner, strict=True)]
            share = np.prod([w if k else 1.0 - w for w, k in zip(position - cell, corner, strict=True)])
            if stride**3 <= size:
                row = node[0] + node[1] * stride + node[2] * stride**2
            else:
                row = node[0] * PRIMES[0] ^ node[1] * PRIMES[1] ^ node[2] * PRIMES[2]
            total += share * table[start + row % 2**32 % size]
        features.extend(total)
        start += size
    return np.array(features)


def network(weights: list[Array], features: Array) -> float:
    hidden = features
    for weight in weights[:-1]:
        hidden = np.maximum(weight @ hidden, 0.0)
    return float(weights[-1][0] @ hidden)


def own_checkpoint(ball: bool = False) -> dict[str, Any]:
    """A checkpoint of the trainer's own kernel: random, or a ball of radius 0.5 in the second level's first feature."""
    rng = np.random.default_rng(3)
    sizes = level_sizes()
    table = rng.normal(size=(sum(sizes), 2))
    weights = [rng.normal(size=shape) / math.sqrt(shape[1]) for shape in ((64, 8), (64, 64), (1, 64))]
    if ball:
        scale = BASE * growth() - 1.0
        nodes = math.ceil(scale) + 2
        places = (np.stack(np.meshgrid(*[np.arange(nodes)] * 3, indexing="ij"), -1) - 0.5) / scale * 2 - 1
        table[:] = 0.0
        distance = np.linalg.norm(places, axis=-1) - 0.5
        table[sizes[0] : sizes[0] + nodes**3, 0] = distance.transpose(2, 1, 0).ravel()  # x fastest
        weights = [np.zeros_like(weight) for weight in weights]
        weights[0][:2, 2] = weights[2][0, :2] = [1.0, -1.0]  # relu(f) - relu(-f)
        weights[1][:2, :2] = np.eye(2)
    model = {
        "encoder.embeddings": torch.from_numpy(table.astype(np.float32)),
        "encoder.offsets": torch.tensor(np.concatenate(([0], np.cumsum(sizes))).astype(np.int32)),
    }
    model |= {f"backbone.{i}.weight": torch.from_numpy(w.astype(np.float32)) for i, w in enumerate(weights)}
    return {"epoch": 9, "global_step": 900, "stats": {"loss": [0.1]}, "model": model}


def tcnn_checkpoint(log2_size: int = 9) -> dict[str, Any]:
    """A checkpoint of tiny-cuda-nn's encoding and fused network, random."""
    rng = np.random.default_rng(5)
    grid = HashGridConfig(log2_table_size=log2_size, per_level_scale=1.3819, interpolation="linear")
    shapes = ((64, 32), (64, 64), (16, 64))
    model = {
        "encoder.params": torch.from_numpy(rng.normal(size=2 * grid.entries).astype(np.float32)),
        "backbone.params": torch.from_numpy(
            np.concatenate([rng.normal(size=a * b) / math.sqrt(b) for a, b in shapes]).astype(np.float32)
        ),
    }
    return {"epoch": 9, "model": model}


def converted(folder: Path, checkpoint: dict[str, Any], overrides: dict[str, Any] | None = None) -> dict[str, Any]:
    torch.save(checkpoint, folder / "ngp_ep0009.pth.tar")
    return convert_file(folder / "ngp_ep0009.pth.tar", folder, overrides, ImportLimits())


def assert_evaluates(field: SdfField, slow: Any) -> None:
    """Values and gradients in the cube are those of ``slow``; beyond it, carried on from the cube's nearest point."""
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (40, 3))
    points[:20] /= 1.5

    def extended(point: Array) -> float:
        inside = np.clip(point, -1.0, 1.0)
        return float(slow(inside) + np.linalg.norm(point - inside))

    distance, gradient = field.signed_distance_and_gradient(torch.from_numpy(points))
    expected = np.array([extended(point) for point in points])
    np.testing.assert_allclose(distance.numpy(), expected, rtol=0, atol=1e-4 * np.ptp(expected))
    slopes = np.array([numeric_gradient(extended, point, 1e-7) for point in points])
    off = np.abs(gradient.numpy() - slopes).max(axis=1) > 1e-3 * np.abs(slopes).max()
    assert off.mean() < 0.06  # a kink of the network between the ends of a difference


RANDOM = {"accept_implausible": True}
"""Networks of random weights are no distances."""


def test_the_trainers_own_kernel(tmp_path: Path) -> None:
    checkpoint = own_checkpoint()
    report = converted(tmp_path, checkpoint, TOP_TOLD | RANDOM)
    assert report["family"] == "torch_ngp"
    model = {name: tensor.numpy().astype(np.float64) for name, tensor in checkpoint["model"].items()}
    weights = [model[f"backbone.{i}.weight"] for i in range(3)]
    field = open_field(tmp_path / FIELD_NAME)
    assert_evaluates(field, lambda point: network(weights, encode(model["encoder.embeddings"], point)))
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(field.to("cpu").signed_distance(points), field.signed_distance(points))


def test_a_ball_is_recognized_without_a_word(tmp_path: Path) -> None:
    report = converted(tmp_path, own_checkpoint(ball=True))
    assert report["warnings"] == []
    assert read_description(tmp_path / FIELD_NAME)["hash"]["base_resolution"] == BASE
    points = torch.tensor([[0.55, 0.0, 0.0], [0.0, -0.2, 0.3], [0.9, 0.9, 0.9]])
    distance = open_field(tmp_path / FIELD_NAME).signed_distance(points)
    torch.testing.assert_close(distance, points.norm(dim=-1) - 0.5, rtol=0, atol=0.01)


GRID_TOLD = {"levels": 16, "features_per_level": 2, "base_resolution": 16, "top_resolution": 128}


def test_tiny_cuda_nn(tmp_path: Path) -> None:
    checkpoint = tcnn_checkpoint()
    report = converted(tmp_path, checkpoint, {"hash": GRID_TOLD} | RANDOM)
    assert report["family"] == "torch_ngp"
    stored = read_description(tmp_path / FIELD_NAME)["hash"]
    assert round(stored["per_level_scale"], 4) == round(8 ** (1 / 15), 4)
    grid = HashGridConfig(**{**stored, "resolutions": None, "strides": None})
    model = {name: tensor.numpy().astype(np.float64) for name, tensor in checkpoint["model"].items()}
    parts = np.split(model["backbone.params"], [2048, 2048 + 4096])
    weights = [part.reshape(shape) for part, shape in zip(parts, ((64, 32), (64, 64), (16, 64)), strict=True)]
    table = model["encoder.params"].reshape(-1, 2)
    assert_evaluates(
        open_field(tmp_path / FIELD_NAME),
        lambda point: network(weights, encode_slowly(grid, table, (point + 1.0) / 2.0)),
    )


def test_a_state_dictionary_alone_is_taken(tmp_path: Path) -> None:
    assert converted(tmp_path, own_checkpoint(ball=True)["model"])["family"] == "torch_ngp"


def changed(name: str, value: Any) -> Any:
    return lambda model: model.update({name: value})


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (changed("encoder.offsets", torch.tensor([0, 5, 9], dtype=torch.int32)), "TENSOR_SHAPE"),
        (changed("encoder.offsets", torch.zeros(5, dtype=torch.int32)), "TENSOR_SHAPE"),
        (changed("encoder.offsets", torch.zeros(0, dtype=torch.int64)), "TENSOR_SHAPE"),
        (changed("encoder.offsets", torch.zeros(5)), "TENSOR_DTYPE"),
        (changed("encoder.embeddings", torch.zeros(100, 2)), "TENSOR_SHAPE"),
        (changed("backbone.0.weight", torch.zeros(64, 9)), "TENSOR_SHAPE"),
        (changed("backbone.2.weight", torch.zeros(1, 63)), "TENSOR_SHAPE"),
        (lambda model: model.pop("backbone.1.weight"), "TENSOR_MISSING"),
        (lambda model: model.pop("encoder.offsets"), "FAMILY_NOT_SUPPORTED"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, change: Any, reason: str) -> None:
    checkpoint = own_checkpoint()
    change(checkpoint["model"])
    assert_refused(lambda: converted(tmp_path, checkpoint, TOP_TOLD), reason)


def test_unusual_grids_and_networks_are_refused(tmp_path: Path) -> None:
    sizes = np.array(level_sizes())
    sizes[1] += 8
    checkpoint = own_checkpoint()
    checkpoint["model"]["encoder.offsets"] = torch.tensor(np.concatenate(([0], np.cumsum(sizes))))
    checkpoint["model"]["encoder.embeddings"] = torch.zeros(int(sizes.sum()), 2)
    assert_refused(lambda: converted(tmp_path, checkpoint), "HASH_GRID_NOT_RECOGNIZED")
    for name in ("encoder.params", "backbone.params"):
        odd = tcnn_checkpoint()
        odd["model"][name] = torch.zeros(1234)
        assert_refused(lambda odd=odd: converted(tmp_path, odd), "HASH_GRID_NOT_RECOGNIZED")
