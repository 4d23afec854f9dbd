"""sdfstudio and nerfstudio: ``outputs/<name>/<method>/<time>/`` with ``config.yml`` full of Python tags."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.trainer_runs.colors import Outputs, color_function, joined, random_layers
from benchmarks.trainer_runs.functions import (
    GridLayout,
    Network,
    growth_to,
    hash_features,
    new_table,
    sines_by_axis,
    sphere_network,
)
from benchmarks.trainer_runs.run import ColorFunction, WrittenRun, newer_names, normalized
from benchmarks.trainer_runs.shapes import random_shape
from benchmarks.trainer_runs.trainers.nerfstudio_config import nerfstudio_config, sdfstudio_config
from benchmarks.trainer_runs.training import train


@dataclass(frozen=True)
class _Method:
    """What one method of the two trainers draws from, and how its function differs."""

    name: str
    nerfstudio: bool
    layers: tuple[int, ...]
    uses_grid: bool
    uses_sines: bool
    features: tuple[int, ...]


_FACTO = _Method("neus-facto", False, (1, 2, 2, 4), True, True, (2, 4, 1))
_NEUS = _Method("neus", False, (5, 6, 8), False, True, (2,))
_ANGELO = _Method("neus-facto-angelo", False, (1, 2), True, False, (8, 4, 2))
_NERFSTUDIO = _Method("neus-facto", True, (1, 2, 2, 4), True, True, (2, 4, 1))


def write_sdfstudio_neus_facto(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """neus-facto of sdfstudio."""
    return _write(folder, rng, steps, _FACTO)


def write_sdfstudio_neus(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """neus of sdfstudio: a deep network that has a grid's columns and never a grid."""
    return _write(folder, rng, steps, _NEUS)


def write_sdfstudio_angelo(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """neus-facto-angelo of sdfstudio: a grid without sines."""
    return _write(folder, rng, steps, _ANGELO)


def write_nerfstudio_neus_facto(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """neus-facto of nerfstudio: 2 pi in the sines, and other names for some settings."""
    return _write(folder, rng, steps, _NERFSTUDIO)


def _draw(rng: np.random.Generator, method: _Method) -> dict[str, Any]:
    base = int(rng.choice([16, 16, 32, 8, 20]))
    return {
        "num_layers": int(rng.choice(method.layers)),
        "hidden_dim": int(rng.choice([64, 96, 128])),
        "geo_feat_dim": int(rng.choice([16, 64])),
        "num_levels": int(rng.choice([8, 12, 16, 16, 14])),
        "max_res": int(rng.choice([256, 512, 1024, 2048, 4096, 1500])),
        "base_res": base,
        "log2_hashmap_size": int(rng.integers(10, 16)),
        "hash_features_per_level": int(rng.choice(method.features)),
        "hash_smoothstep": bool(rng.random() < (0.2 if method is _ANGELO else 0.7)),
        "use_grid_feature": method.uses_grid,
        "use_position_encoding": method.uses_sines,
        "position_encoding_max_degree": 6 if method.nerfstudio else int(rng.choice([6, 6, 4, 8])),
        "bias": float(rng.choice([0.5, 0.3, 0.8])),
        "inside_outside": False,
        "weight_norm": True,
    }


def _write(folder: Path, rng: np.random.Generator, steps: int, method: _Method) -> WrittenRun:
    said = _draw(rng, method)
    layout = GridLayout(
        said["num_levels"],
        said["hash_features_per_level"],
        said["log2_hashmap_size"],
        said["base_res"],
        growth_to(said["base_res"], said["max_res"], said["num_levels"]),
        said["hash_smoothstep"],
    )
    degree, depth = said["position_encoding_max_degree"], said["num_layers"]
    width = 3 + 6 * degree + layout.levels * layout.features
    skips = [4] if depth >= 4 else []
    widths = [width, *[max(said["hidden_dim"], width + 24) if skips else said["hidden_dim"]] * depth]
    said["hidden_dim"] = widths[1]
    network = sphere_network(rng, [*widths, 1 + said["geo_feat_dim"]], 3, skips, said["bias"])
    table, factor = new_table(rng, layout), 2 * np.pi if method.nerfstudio else 1.0

    def results(x: Tensor, net: Network = network, entries: Tensor = table) -> Tensor:
        sines = sines_by_axis(x, degree, factor)
        grid = torch.zeros(len(x), layout.levels * layout.features, dtype=x.dtype)
        if method.uses_grid:
            grid = hash_features(layout, entries, (x + 2) / 4)
        return net(torch.cat((x, sines if method.uses_sines else sines * 0, grid), dim=1))

    def value(x: Tensor, net: Network = network, entries: Tensor = table) -> Tensor:
        return results(x, net, entries)[:, 0]

    trained = [*network.parameters(), *([table] if method.uses_grid else [])]
    train(value, trained, random_shape(rng), rng, steps, 2e-3)
    step = int(rng.choice([20000, 30000, 99999]))
    state = _state(rng, method, network, table)
    net, entries = network.double(), table.detach().double()
    color = _add_color(rng, method, said, state, lambda x: results(x, net, entries))
    checkpoint = _save(folder, rng, method, said, state, step)
    return WrittenRun(folder, checkpoint, said, lambda x: value(x, net, entries), color=color)


def _add_color(
    rng: np.random.Generator, method: _Method, said: dict[str, Any], state: dict[str, Tensor], outputs: Outputs
) -> ColorFunction:
    """A random color network in ``state``, and its settings in ``said``."""
    prefix = next(key for key in state if key.endswith(".aabb")).removesuffix("aabb")
    embedding = int(rng.choice([32, 16, 8]))
    rows = torch.tensor(rng.normal(size=(7, embedding)), dtype=torch.float32)
    layers = random_layers(
        rng, 33 + said["geo_feat_dim"] + embedding, int(rng.choice([48, 64])), int(rng.integers(1, 5))
    )
    state |= layers.state(rng, f"{prefix}clin") | {f"{prefix}embedding_appearance.embedding.weight": rows}
    average = bool(rng.random() < 0.5)
    padding = 0.0 if method.nerfstudio else float(rng.choice([0.001, 0.001, 0.01]))
    said |= {"rgb_padding": padding, "use_average_appearance_embedding": average}
    appearance = rows.double().mean(0) if average else torch.zeros(embedding)
    factor = 2 * np.pi if method.nerfstudio else 1.0

    def combine(x: Tensor, d: Tensor, gradient: Tensor, found: Tensor) -> Tensor:
        parts = [x, sines_by_axis(d, 4, factor), d, gradient, found[:, 1:], appearance.expand(len(x), -1)]
        return torch.sigmoid(layers(joined(parts))) * (1 + 2 * padding) - padding

    return color_function(outputs, combine)


def _state(rng: np.random.Generator, method: _Method, network: Network, table: Tensor) -> dict[str, Tensor]:
    prefix = str(rng.choice(["_model.field.", "_model.module.field."])) if not method.nerfstudio else "_model.field."
    layers = {}
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        factors = torch.tensor(rng.uniform(0.5, 2, len(weight)), dtype=torch.float32)
        parts = {"bias": bias.detach(), **normalized(weight, factors)}
        layers |= {f"{prefix}glin{i}.{name}": part for name, part in parts.items()}
    state = {
        f"{prefix}aabb": torch.tensor([[-1.0] * 3, [1.0] * 3]),
        f"{prefix}encoding.params": table.detach().reshape(-1),
        f"{prefix}deviation_network.variance": torch.tensor([0.3]),
        "_model.proposal_networks.0.encoding.params": torch.zeros(64),
        **(newer_names(layers) if method.nerfstudio and rng.random() < 0.3 else layers),
    }
    if not method.nerfstudio:
        state[f"{prefix}laplace_density.beta"] = torch.tensor(0.1)
        state[f"{prefix}laplace_density.beta_min"] = torch.tensor(1e-4)
        state["datamanager.train_ray_generator.image_coords"] = torch.zeros(2, 2, 2)
    return state


def _save(
    folder: Path,
    rng: np.random.Generator,
    method: _Method,
    said: dict[str, Any],
    state: dict[str, Tensor],
    step: int,
) -> Path:
    run = folder / "outputs" / "thing" / method.name / "2023-05-01_101500"
    models = run / ("nerfstudio_models" if method.nerfstudio else "sdfstudio_models")
    models.mkdir(parents=True)
    checkpoint = models / f"step-{step:09d}.ckpt"
    optimizers = {"fields": {"param_groups": [{"lr": np.float64(5e-4)}]}}
    torch.save({"step": step, "pipeline": state, "optimizers": optimizers, "schedulers": {}, "scalers": {}}, checkpoint)
    write = nerfstudio_config if method.nerfstudio else sdfstudio_config
    (run / "config.yml").write_text(write(method.name, said))
    if method.nerfstudio:
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        q *= np.sign(np.linalg.det(q))
        transform = np.concatenate((q, rng.normal(size=(3, 1))), axis=1).tolist()
        (run / "dataparser_transforms.json").write_text(json.dumps({"transform": transform, "scale": 0.4375}))
    return checkpoint
