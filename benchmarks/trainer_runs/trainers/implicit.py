"""VolSDF and IDR: ``exps/<name>/<time>/checkpoints/ModelParameters/*.pth`` with ``runconf.conf`` beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.trainer_runs.functions import Network, sines_by_frequency, sphere_network
from benchmarks.trainer_runs.run import WrittenRun, normalized
from benchmarks.trainer_runs.shapes import random_shape
from benchmarks.trainer_runs.training import train


def write_volsdf(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """A run with a bounding sphere, near which its renderer, not its mesh, has the distance to that sphere instead."""
    radius, factor = float(rng.choice([3.0, 2.5, 5.0, 2.0])), float(rng.choice([1.0, 20.0, 10.0]))
    said = _network_settings(rng)
    if factor != 1.0 or rng.random() < 0.3:
        said["sphere_scale"] = factor
    return _write(folder, rng, steps, said, f"    scene_bounding_sphere = {radius}\n")


def write_idr(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """A run without a bounding sphere."""
    return _write(folder, rng, steps, _network_settings(rng), "")


def _network_settings(rng: np.random.Generator) -> dict[str, Any]:
    depth, width = int(rng.integers(3, 9)), int(rng.choice([64, 96, 128]))
    return {
        "d_in": 3,
        "d_out": 1,
        "dims": [width] * depth,
        "geometric_init": True,
        "bias": float(rng.choice([0.6, 0.5, 0.9])),
        "skip_in": [int(rng.integers(2, depth))] if depth > 2 and rng.random() < 0.8 else [],
        "weight_norm": bool(rng.random() < 0.9),
        "multires": int(rng.choice([6, 6, 4, 8, 0])),
    }


def _write(folder: Path, rng: np.random.Generator, steps: int, said: dict[str, Any], more: str) -> WrittenRun:
    features, degree = int(rng.choice([0, 64, 128])), said["multires"]
    widths = [3 + 6 * degree, *said["dims"], said["d_out"] + features]
    network = sphere_network(rng, widths, 3, said["skip_in"], said["bias"])

    def value(x: Tensor, net: Network = network) -> Tensor:
        return net(torch.cat((x, sines_by_frequency(x, degree)), dim=1))[:, 0]

    train(value, network.parameters(), random_shape(rng), rng, steps, 1e-3)
    prefix = str(rng.choice(["", "module."]))
    state = implicit_state(rng, network, f"{prefix}implicit_network.", said["weight_norm"])
    state[f"{prefix}rendering_network.lin0.bias"] = torch.zeros(8)
    if more:
        state[f"{prefix}density.beta"] = torch.tensor(0.05)
    time = folder / "exps" / "thing_1" / "2022_03_01_10_20_30"
    checkpoint = time / "checkpoints" / "ModelParameters" / "latest.pth"
    checkpoint.parent.mkdir(parents=True)
    torch.save({"epoch": 2000, "model_state_dict": state}, checkpoint)
    (time / "runconf.conf").write_text(_conf(said, features, more))
    net = network.double()
    return WrittenRun(folder, checkpoint, {**said, "sphere": more.strip()}, lambda x: value(x, net))


def implicit_state(rng: np.random.Generator, network: Network, prefix: str, is_normalized: bool) -> dict[str, Tensor]:
    """The tensors ``<prefix>lin*``."""
    state = {}
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        factors = torch.tensor(rng.uniform(0.5, 2, len(weight)), dtype=torch.float32)
        parts = normalized(weight, factors) if is_normalized else {"weight": weight.detach()}
        state |= {f"{prefix}lin{i}.{name}": part for name, part in parts.items()}
        state[f"{prefix}lin{i}.bias"] = bias.detach()
    return state


def _conf(said: dict[str, Any], features: int, more: str) -> str:
    lines = "\n".join(f"        {key} = {entry}" for key, entry in said.items())
    return f"""train{{
    expname = thing
    learning_rate = 5.0e-4
}}
model{{
    feature_vector_size = {features}
{more}
    implicit_network
    {{
{lines}
    }}
    rendering_network
    {{
        mode = idr
        d_in = 9
        dims = [ 256, 256]
    }}
}}
"""
