"""Checkpoints as the trainers of hash grids leave them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.checkpoint_layouts.settings import Settings
from benchmarks.checkpoint_layouts.training import Trained


def write(path: Path, settings: Settings, field: Trained) -> None:
    """The checkpoint of ``field`` at ``path``."""
    torch.save(_WRITERS[settings.family](settings, field), path)


def _studio(settings: Settings, field: Trained) -> dict[str, Any]:
    state = {"aabb": torch.tensor([[-1.0] * 3, [1.0] * 3]), "encoding.params": field.table.reshape(-1)}
    state |= _normalized(field, [f"glin{i}" for i in range(len(field.weights))])
    if settings.family == "sdfstudio":
        state["laplace_density.beta"] = torch.tensor([0.1])
    pipeline = {f"_model.field.{name}": value for name, value in state.items()}
    return {"step": 20000, "pipeline": pipeline, "optimizers": {}}


def _instant(settings: Settings, field: Trained) -> dict[str, Any]:
    progressive = settings.open_levels < settings.grid.levels
    first = field.weights[0].clone()
    first[:, :3] *= settings.radius  # the trainer feeds x / r
    field = Trained(field.table, [first, *field.weights[1:]], field.biases)
    names = [f"network.layers.{2 * i}" for i in range(len(field.weights))]
    table = "encoding.encoding.encoding.params" if progressive else "encoding.encoding.params"
    state = {table: field.table.reshape(-1), **_normalized(field, names)}
    named = {f"model.geometry.{name}": value for name, value in state.items()}
    box = torch.tensor([-settings.radius] * 3 + [settings.radius] * 3)
    step = (settings.open_levels - min(4, settings.grid.levels)) * 1000 + 500 if progressive else 20000
    return {"state_dict": {**named, "model.scene_aabb": box}, "epoch": 0, "global_step": step}


def _neuralangelo(settings: Settings, field: Trained) -> dict[str, Any]:
    hidden = len(field.weights) - 1
    names = [*(f"mlp.linears.{i}" for i in range(hidden)), "mlp.linear_sdf"]
    state = {"tcnn_encoding.params": field.table.reshape(-1)}
    state |= _normalized(Trained(field.table, field.weights[:-1], field.biases[:-1]), names[:-1])
    state |= {"mlp.linear_sdf.weight": field.weights[-1], "mlp.linear_sdf.bias": field.biases[-1]}
    extra = torch.ones(3, field.weights[-1].shape[1])
    state |= {f"mlp.linears.{hidden}.weight": extra, f"mlp.linears.{hidden}.bias": torch.zeros(3)}
    iteration = 5000 + 5000 * settings.open_levels
    return {"model": {f"module.neural_sdf.{n}": v for n, v in state.items()}, "iteration": iteration, "epoch": 1}


def _normalized(field: Trained, names: list[str]) -> dict[str, Tensor]:
    state = {}
    for name, weight, bias in zip(names, field.weights, field.biases, strict=True):
        state[f"{name}.weight_v"] = weight
        state[f"{name}.weight_g"] = weight.norm(dim=1, keepdim=True)
        state[f"{name}.bias"] = bias
    return state


_WRITERS = {
    "sdfstudio": _studio,
    "nerfstudio": _studio,
    "instant_nsr_pl": _instant,
    "neuralangelo": _neuralangelo,
}
