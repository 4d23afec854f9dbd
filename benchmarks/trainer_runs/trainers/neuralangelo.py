"""Neuralangelo: ``logs/<group>/<name>/epoch_*_iteration_*_checkpoint.pt`` with ``config.yaml`` beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from benchmarks.trainer_runs.functions import GridLayout, Network, growth_to, hash_features, new_table, sphere_network
from benchmarks.trainer_runs.run import WrittenRun, normalized
from benchmarks.trainer_runs.shapes import random_shape
from benchmarks.trainer_runs.training import train

_WARM_UP = 5000


def write_neuralangelo(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """A run of a random grid, range and network, with levels that open by the stored iteration."""
    levels, low, high = int(rng.choice([8, 10, 12, 16])), int(rng.integers(3, 6)), int(rng.integers(7, 12))
    layout = GridLayout(
        levels=levels,
        features=int(rng.choice([8, 4, 2])),
        log2_size=int(rng.integers(10, 15)),
        base=1 << low,
        growth=growth_to(1 << low, 1 << high, levels),
        smoothstep=False,
    )
    reach = float(rng.choice([2.0, 2.0, 1.0, 1.5]))
    stepwise = {"enabled": bool(rng.random() < 0.7), "init_active_level": int(rng.choice([4, 8])), "step": 5000}
    iteration = int(rng.choice([20_000, 60_000, 500_000]))
    opened = min(levels, max((iteration - _WARM_UP) // stepwise["step"], 1))
    active = min(max(stepwise["init_active_level"], opened), levels) if stepwise["enabled"] else None
    hidden = int(rng.choice([64, 96, 128]))
    network = sphere_network(rng, [3 + levels * layout.features, hidden, 1], 3, (), 0.5)
    table = new_table(rng, layout)

    def value(x: Tensor, net: Network = network, entries: Tensor = table) -> Tensor:
        features = hash_features(layout, entries, (x + reach) / (2 * reach), active)
        return net(torch.cat((x, features), dim=1))[:, 0]

    train(value, [*network.parameters(), table], random_shape(rng), rng, steps, 2e-3)
    checkpoint = folder / "logs" / "group" / "thing" / f"epoch_01020_iteration_{iteration:09d}_checkpoint.pt"
    checkpoint.parent.mkdir(parents=True)
    content = {"model": _state(rng, network, table), "optim": {}, "sched": {}, "epoch": 1020, "iteration": iteration}
    torch.save(content, checkpoint)
    settings = _settings(layout, (low, high), reach, hidden, stepwise)
    (checkpoint.parent / "config.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))
    net, entries = network.double(), table.detach().double()
    said = {"layout": layout, "range": reach, "active": active, "iteration": iteration}
    return WrittenRun(folder, checkpoint, said, lambda x: value(x, net, entries))


def _state(rng: np.random.Generator, network: Network, table: Tensor) -> dict[str, Tensor]:
    prefix = "module.neural_sdf."
    first = torch.tensor(rng.uniform(0.5, 2, len(network.weights[0])), dtype=torch.float32)
    second = torch.tensor(rng.normal(size=(16, len(network.weights[0]))), dtype=torch.float32)
    state = {f"{prefix}tcnn_encoding.params": table.detach().reshape(-1)}
    for name, part in {"bias": network.biases[0].detach(), **normalized(network.weights[0], first)}.items():
        state[f"{prefix}mlp.linears.0.{name}"] = part
    for name, part in {"bias": torch.zeros(16), **normalized(second, torch.ones(16))}.items():
        state[f"{prefix}mlp.linears.1.{name}"] = part
    state[f"{prefix}mlp.linear_sdf.weight"] = network.weights[1].detach()
    state[f"{prefix}mlp.linear_sdf.bias"] = network.biases[1].detach()
    return state | {"module.s_var": torch.tensor(3.0), "module.neural_rgb.mlp.linears.0.bias": torch.zeros(4)}


def _settings(
    layout: GridLayout, logs: tuple[int, int], reach: float, hidden: int, stepwise: dict[str, Any]
) -> dict[str, Any]:
    mlp = {
        "num_layers": 1,
        "hidden_dim": hidden,
        "skip": [],
        "activ": "softplus",
        "activ_params": {"beta": 100},
        "geometric_init": True,
        "weight_norm": True,
        "out_bias": 0.5,
        "inside_out": False,
    }
    grid = {
        "min_logres": logs[0],
        "max_logres": logs[1],
        "dict_size": layout.log2_size,
        "dim": layout.features,
        "range": [-reach, reach],
    }
    encoding = {"type": "hashgrid", "levels": layout.levels, "hashgrid": grid, "coarse2fine": stepwise}
    model = {"type": "projects.neuralangelo.model", "object": {"sdf": {"mlp": mlp, "encoding": encoding}}}
    schedule = {"warm_up_end": _WARM_UP, "two_steps": [300000, 400000]}
    return {"max_iter": 500000, "model": model, "optim": {"sched": schedule}, "data": {"root": "datasets/thing"}}
