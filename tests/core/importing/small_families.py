"""Small checkpoints as the families' trainers save them, each with its function at one point, straight from the papers.

The functions are slow, in float64, and share nothing with the package but the layout of the hash grid.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from regnf_core.schema.hash_grid_config import HashGridConfig
from tests.core.fields.reference import encode_slowly

Array = NDArray[np.float64]
Function = Callable[[Array], float]
_rng = np.random.default_rng


@dataclass(frozen=True)
class Sample:
    """A checkpoint's dictionary and the distance at a point (3,)."""

    checkpoint: dict[str, Any]
    function: Function


def softplus(a: Array) -> Array:
    return np.asarray(np.logaddexp(100.0 * a, 0.0) / 100.0)


def linear(rng: np.random.Generator, rows: int, columns: int) -> tuple[Array, Array]:
    """A random layer, (weight, bias), whose numbers float32 can hold."""
    weight = rng.normal(size=(rows, columns)) * math.sqrt(2.0 / columns)
    return weight.astype(np.float32).astype(np.float64), (0.1 * rng.normal(size=rows)).astype(np.float32).astype(float)


def normalized(name: str, weight: Array, bias: Array) -> dict[str, torch.Tensor]:
    """A layer's three tensors under weight normalization, the direction of some other length than 1."""
    return {
        f"{name}.bias": torch.from_numpy(bias).float(),
        f"{name}.weight_g": torch.from_numpy(np.linalg.norm(weight, axis=1, keepdims=True)).float(),
        f"{name}.weight_v": torch.from_numpy(1.7 * weight).float(),
    }


def plain(name: str, weight: Array, bias: Array) -> dict[str, torch.Tensor]:
    return {f"{name}.weight": torch.from_numpy(weight).float(), f"{name}.bias": torch.from_numpy(bias).float()}


def centered(function: Function, last_bias: Array) -> None:
    """Shift the last layer's bias so that about half of [-1, 1]^3 is inside: every sample has a surface."""
    points = _rng(1).uniform(-1.0, 1.0, (101, 3))
    last_bias[0] -= np.median([function(point) for point in points])
    last_bias[0] = np.float32(last_bias[0])


def neus(skip: int = 3, multires: int = 3) -> Sample:
    """SDFNetwork: x and its sines and cosines, frequency by frequency; the skip gives [h, input] / sqrt 2."""
    rng, hidden, inputs = _rng(5), 24, 3 + 6 * multires
    rows = [hidden] * 5 + [9]
    rows[skip - 1] -= inputs
    layers, columns = [], inputs
    for i, out in enumerate(rows):
        layers.append(linear(rng, out, columns + (inputs if i == skip else 0)))
        columns = out

    def function(x: Array) -> float:
        waves = [wave(2.0**k * x) for k in range(multires) for wave in (np.sin, np.cos)]
        features = h = np.concatenate((x, *waves))
        for i, (weight, bias) in enumerate(layers):
            if i == skip:
                h = np.concatenate((h, features)) / math.sqrt(2.0)
            h = weight @ h + bias
            if i < len(layers) - 1:
                h = softplus(h)
        return float(h[0])

    centered(function, layers[-1][1])
    state = OrderedDict[str, torch.Tensor]()
    for i, (weight, bias) in enumerate(layers):
        state |= normalized(f"lin{i}", weight, bias)
    beside = {"variance_network_fine": {"variance": torch.ones(())}, "iter_step": 300_000}
    return Sample({"sdf_network_fine": state} | beside, function)


def siren() -> Sample:
    """SingleBVPNet of sines: sin(30 (W h + b)), the last layer linear."""
    rng = _rng(6)
    sizes = [(16, 3), (16, 16), (16, 16), (1, 16)]
    layers = []
    for rows, columns in sizes:
        weight, bias = linear(rng, rows, columns)
        layers.append(((weight / 10.0).astype(np.float32).astype(float), bias))

    def function(x: Array) -> float:
        h = x
        for weight, bias in layers[:-1]:
            h = np.sin(30.0 * (weight @ h + bias))
        return float((layers[-1][0] @ h + layers[-1][1])[0])

    centered(function, layers[-1][1])
    state = OrderedDict[str, torch.Tensor]()
    for i, (weight, bias) in enumerate(layers):
        state |= plain(f"net.net.{i}.0", weight, bias)
    return Sample(state, function)


def deepsdf(
    code: int = 1, width: int = 5, xyz_in_all: bool = False, weight_norm: bool = True, latent_in: int = 2
) -> Sample:
    """Decoder: [latent, xyz], ReLU, the input again at ``latent_in``, tanh at the end; three shapes."""
    rng, hidden = _rng(7), 16
    latents = rng.normal(size=(3, width)).astype(np.float32).astype(float)
    layers, norms = [], []
    for i in range(5):
        seen = (width + 3 if i == latent_in else 3 if xyz_in_all else 0) if i else 0
        layers.append(linear(rng, 1 if i == 4 else hidden, (width + 3) if i == 0 else hidden + seen))
        norms.append((rng.uniform(0.5, 1.5, hidden), 0.1 * rng.normal(size=hidden)))
    norms = [(g.astype(np.float32).astype(float), b.astype(np.float32).astype(float)) for g, b in norms]

    def function(x: Array) -> float:
        features = h = np.concatenate((latents[code], x))
        for i, (weight, bias) in enumerate(layers):
            if i == latent_in:
                h = np.concatenate((h, features))
            elif i and xyz_in_all:
                h = np.concatenate((h, x))
            h = weight @ h + bias
            if i < 4:
                if not weight_norm:
                    h = (h - h.mean()) / np.sqrt(h.var() + 1e-5) * norms[i][0] + norms[i][1]
                h = np.maximum(h, 0.0)
        return math.tanh(h[0])

    layers[-1][1][0] = np.float32(-0.3)
    centered(lambda x: math.atanh(function(x)), layers[-1][1])
    state = OrderedDict[str, torch.Tensor]()
    for i, (weight, bias) in enumerate(layers):
        state |= (normalized if weight_norm and i < 4 else plain)(f"module.lin{i}", weight, bias)
        if not weight_norm and i < 4:
            gain, shift = norms[i]
            state |= {f"module.bn{i}.weight": torch.from_numpy(gain).float()}
            state |= {f"module.bn{i}.bias": torch.from_numpy(shift).float()}
    codes = {"weight": torch.from_numpy(latents).float()}
    return Sample({"epoch": 2000, "model_state_dict": state, "latent_codes": codes}, function)


def _gridded(
    grid: HashGridConfig, active: int, radius: float, per_radius: bool, relu: bool = False
) -> tuple[Function, Array, list[tuple[Array, Array]]]:
    """[x (or x / radius), features of the grid over [-radius, radius]^3, finer levels zero] -> softplus -> distance."""
    rng = _rng(8)
    sizes = np.repeat([16.0 / nodes for nodes in grid.level_resolutions()], grid.level_entries())  # as trained ones are
    table = rng.normal(size=(grid.entries, grid.features_per_level)) * sizes[:, None]
    table = table.astype(np.float32).astype(float)
    layers = [linear(rng, 12, 3 + grid.width), linear(rng, 5, 12)]

    def function(x: Array) -> float:
        features = encode_slowly(grid, table, (x + radius) / (2.0 * radius))
        features[active * grid.features_per_level :] = 0.0
        h = np.concatenate((x / radius if per_radius else x, features))
        a = layers[0][0] @ h + layers[0][1]
        h = np.maximum(a, 0.0) if relu else softplus(a)
        return float((layers[1][0] @ h + layers[1][1])[0])

    centered(function, layers[1][1])
    return function, table, layers


def instant_nsr_pl(
    step: int = 20_000, progressive: bool = False, relu: bool = False, active: int | None = None
) -> Sample:
    """VolumeSDF with a VanillaMLP, six levels; the progressive grid opens one every 1000 steps, from four on."""
    grid = HashGridConfig.from_top_resolution(
        2048, levels=6, base_resolution=16, log2_table_size=9, interpolation="linear"
    )
    active = active or (min(6, 4 + step // 1000) if progressive else 6)
    function, table, layers = _gridded(grid, active, 1.5, per_radius=True, relu=relu)
    name = "model.geometry.encoding.encoding." + ("encoding.params" if progressive else "params")
    state = OrderedDict({name: torch.from_numpy(table).float().flatten()})
    state["model.scene_aabb"] = torch.tensor([-1.5] * 3 + [1.5] * 3)
    for i, (weight, bias) in enumerate(layers):
        state |= normalized(f"model.geometry.network.layers.{2 * i}", weight, bias)
    state["model.texture.network.params"] = torch.ones(4)
    return Sample({"state_dict": state, "epoch": 0, "global_step": step}, function)


def neuralangelo(iteration: int = 500_000, first_levels: int = 4) -> Sample:
    """NeuralSDF with one hidden layer, ten levels; coarse to fine opens one every 5000 iterations after 5000."""
    grid = HashGridConfig.from_top_resolution(
        2048, levels=10, base_resolution=32, log2_table_size=9, interpolation="linear"
    )
    active = max(first_levels, min(10, max((iteration - 5000) // 5000, 1)))
    function, table, layers = _gridded(grid, active, 2.0, per_radius=False)
    closed = sum(grid.level_entries()[:active])
    table[closed:] = _rng(9).uniform(-1e-4, 1e-4, table[closed:].shape)
    state = OrderedDict({"module.neural_sdf.tcnn_encoding.params": torch.from_numpy(table).float().flatten()})
    state |= normalized("module.neural_sdf.mlp.linears.0", *layers[0])
    state |= normalized("module.neural_sdf.mlp.linears.1", np.ones((4, 12)), np.zeros(4))
    state |= plain("module.neural_sdf.mlp.linear_sdf", layers[1][0][:1], layers[1][1][:1])
    state["module.s_var"] = torch.ones(())
    return Sample({"model": state, "optim": {}, "epoch": 1, "iteration": iteration}, function)
