"""Co-SLAM: ``output/<dataset>/<scene>/<name>/checkpoint*.pt`` with config.json beside it."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.trainer_runs.functions import GridLayout, Network, growth_to, hash_features, new_table
from benchmarks.trainer_runs.run import WrittenRun
from benchmarks.trainer_runs.shapes import random_shape
from benchmarks.trainer_runs.training import train

_LEVELS, _FEATURES, _BASE = 16, 2, 16


def write_co_slam(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """A run in a random box round [-1, 1]^3, so many units to the meter."""
    factor = float(rng.choice([1.0, 1.0, 1.0, 0.5]))
    low, high = -rng.uniform(1.0, 3.0, 3).round(1), rng.uniform(1.0, 3.0, 3).round(1)
    voxel = float(rng.choice([0.02, 0.04, 0.05, 0.03, 160, 256]))
    bins, hidden, depth = int(rng.choice([16, 16, 8, 4])), int(rng.choice([32, 64])), int(rng.choice([2, 2, 3]))
    log2_size, truncation = int(rng.choice([10, 12, 14, 16])), float(rng.choice([0.1, 0.05, 0.2]))
    top = _resolution(low, high, voxel)
    layout = GridLayout(_LEVELS, _FEATURES, log2_size, _BASE, growth_to(_BASE, top, _LEVELS), False)
    network, table = _ball(rng, (low, high, bins), hidden, depth), new_table(rng, layout)
    lowest, size = torch.tensor(low), torch.tensor(high - low)

    def value(x: Tensor, net: Network = network, entries: Tensor = table) -> Tensor:
        unit = (x - lowest.to(x)) / size.to(x)
        fed = torch.cat((hash_features(layout, entries, unit), one_blob(unit, bins)), dim=1)
        return net(fed)[:, 0] * truncation * factor

    train(value, [*network.weights, table], random_shape(rng), rng, steps, 2e-3)
    state = {f"decoder.sdf_net.model.{2 * i}.weight": weight.detach() for i, weight in enumerate(network.weights)}
    state |= {"embed_fn.params": table.detach().reshape(-1), "embedpos_fn.params": torch.zeros(0)}
    state["decoder.color_net.model.0.weight"] = torch.zeros(4, 4)
    place = folder / "output" / "Replica" / "office0" / "demo"
    place.mkdir(parents=True)
    torch.save({"pose": {0: torch.eye(4)}, "pose_rel": {}, "model": state}, place / "checkpoint1999.pt")
    said = {
        "data": {"sc_factor": factor, "translation": 0, "output": "output/Replica/office0", "exp_name": "demo"},
        "mapping": {"bound": np.stack((low, high), axis=1).tolist(), "sample": 2048},
        "grid": {"enc": "HashGrid", "tcnn_encoding": True, "hash_size": log2_size, "voxel_sdf": voxel, "oneGrid": True},
        "pos": {"enc": "OneBlob", "n_bins": bins},
        "decoder": {"geo_feat_dim": 15, "hidden_dim": hidden, "num_layers": depth, "tcnn_network": False},
        "training": {"trunc": truncation, "sdf_weight": 1000},
    }
    (place / "config.json").write_text(json.dumps(said, indent=4))
    net, entries = network.double(), table.detach().double()
    return WrittenRun(folder, place / "checkpoint1999.pt", said, lambda x: value(x, net, entries))


def _resolution(low: np.ndarray, high: np.ndarray, voxel: float) -> int:
    """The longest edge in voxels, in single precision, as a device that multiplies by the inverse has it."""
    if voxel > 10:
        return int(voxel)
    longest = (high.astype(np.float32) - low.astype(np.float32)).max()
    return int(longest * (np.float32(1) / np.float32(voxel)))


def _ball(rng: np.random.Generator, box: tuple[np.ndarray, np.ndarray, int], hidden: int, depth: int) -> Network:
    """A network that begins near the distance to a ball: x^2 + y^2 + z^2 is a sum over the bins of the three axes."""
    low, high, bins = box
    middles = low[:, None] + (high - low)[:, None] * (np.arange(bins) + 0.5) / bins
    blur = ((high - low) / bins) ** 2 * (1 / 12 + 1 / 7)  # of a bin, and of the bump
    row = np.concatenate((rng.uniform(-1, 1, 32), (middles**2 - blur[:, None] - 0.4**2).ravel()))
    widths = [len(row), *[hidden] * (depth - 1), 16]
    weights = [rng.normal(0, 0.1 / before**0.5, (after, before)) for before, after in itertools.pairwise(widths)]
    weights[0][:2] = np.stack((row, -row))
    for weight in weights[1:-1]:
        weight[:2] = np.eye(2, hidden)
    weights[-1][0, :2] = 10.0, -10.0  # relu(d) - relu(-d), in truncations
    tensors = [torch.tensor(weight, dtype=torch.float32, requires_grad=True) for weight in weights]
    return Network(tensors, [torch.zeros(len(weight)) for weight in weights], activation=torch.relu)


def one_blob(unit: Tensor, bins: int) -> Tensor:
    """Features (N, 3 bins): the integrals over the bins of 15/16 (1 - u^2)^2, u in bins from the coordinate."""
    places = unit[:, :, None] * bins
    total = torch.zeros(*unit.shape, bins, dtype=unit.dtype)
    for turn in (-bins, 0, bins):  # the interval is a ring
        left = (torch.arange(bins).to(unit) + turn - places).clamp(-1, 1)
        right = (torch.arange(1, bins + 1).to(unit) + turn - places).clamp(-1, 1)
        total = total + _area(right) - _area(left)
    return total.flatten(1)


def _area(u: Tensor) -> Tensor:
    return 15 / 16 * (u - 2 * u**3 / 3 + u**5 / 5)
