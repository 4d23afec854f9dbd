"""instant-nsr-pl: ``exp/<name>/<tag>/ckpt/epoch=*-step=*.ckpt`` with ``config/parsed.yaml``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from benchmarks.trainer_runs.colors import Outputs, color_function, flat_state, harmonics, joined, random_layers
from benchmarks.trainer_runs.functions import GridLayout, Network, hash_features, new_table, sphere_network
from benchmarks.trainer_runs.run import ColorFunction, WrittenRun, newer_names, normalized
from benchmarks.trainer_runs.shapes import random_shape
from benchmarks.trainer_runs.training import train


def write_instant_nsr_pl(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """A run of a random grid, radius and network; half of them mask levels by the step that is stored."""
    layout = GridLayout(
        levels=int(rng.choice([8, 10, 12, 14, 16])),
        features=int(rng.choice([2, 2, 4, 1])),
        log2_size=int(rng.integers(10, 16)),
        base=int(rng.choice([16, 32, 8, 24])),
        growth=float(rng.choice([1.3195079107728942, 1.447269237440378, 1.38, 1.25, 1.5])),
        smoothstep=False,
    )
    radius = float(rng.choice([1.0, 1.5, 0.6, 2.0]))
    progressive = bool(rng.random() < 0.5)
    mask = {"start_level": int(rng.integers(2, 5)), "start_step": 0, "update_steps": int(rng.choice([500, 1000]))}
    step = int(rng.choice([3000, 8000, 20000]))
    active = min(mask["start_level"] + step // mask["update_steps"], layout.levels) if progressive else None
    hidden, depth = int(rng.choice([32, 64])), int(rng.choice([1, 1, 2]))
    widths = [3 + layout.levels * layout.features, *[hidden] * depth, int(rng.choice([13, 17]))]
    network, table = sphere_network(rng, widths, 3, (), 0.5 / radius), new_table(rng, layout)

    def results(x: Tensor, net: Network = network, entries: Tensor = table) -> Tensor:
        unit = (x + radius) / (2 * radius)
        return net(torch.cat((2 * unit - 1, hash_features(layout, entries, unit, active)), dim=1))

    def value(x: Tensor, net: Network = network, entries: Tensor = table) -> Tensor:
        return results(x, net, entries)[:, 0]

    shape = random_shape(rng)
    train(value, [*network.parameters(), table], shape, rng, steps, 3e-3)
    state = _state(rng, network, table, radius, progressive)
    net, entries = network.double(), table.detach().double()
    colors, texture, color = _color(rng, widths[-1], lambda x: results(x, net, entries))
    state |= colors
    trial = folder / "exp" / "neus-thing" / "@20230601-101010"
    checkpoint = trial / "ckpt" / f"epoch=0-step={step}.ckpt"
    checkpoint.parent.mkdir(parents=True)
    torch.save({"epoch": 0, "global_step": step, "state_dict": state, "loops": {}, "optimizer_states": []}, checkpoint)
    (trial / "config").mkdir()
    settings = _settings(layout, radius, (hidden, depth, widths[-1]), mask if progressive else {})
    settings["model"]["texture"] = texture
    (trial / "config" / "parsed.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))
    said = {"layout": layout, "radius": radius, "active": active, "depth": depth}
    reach = 0.95 * min(radius, 1.0)
    return WrittenRun(folder, checkpoint, said, lambda x: value(x, net, entries), reach, color=color)


def _color(
    rng: np.random.Generator, features: int, outputs: Outputs
) -> tuple[dict[str, Tensor], dict[str, Any], ColorFunction]:
    """A random color network, of plain layers or fully fused: its state, its settings, its function."""
    degree, fused = int(rng.choice([4, 4, 3, 2])), bool(rng.random() < 0.5)
    inputs, width, depth = features + degree**2 + 3, int(rng.choice([64, 32])), int(rng.integers(1, 4))
    layers = random_layers(rng, inputs, width, depth)
    state = layers.state(rng, "model.texture.network.layers.", False, 2)
    if fused:
        for bias in layers.biases:
            bias.zero_()
        state = {"model.texture.network.params": flat_state(layers, inputs)}

    def combine(x: Tensor, d: Tensor, gradient: Tensor, found: Tensor) -> Tensor:
        del x
        unit = gradient / gradient.norm(dim=1, keepdim=True)
        return torch.sigmoid(layers(joined([found, harmonics(d, degree), unit])))

    network = {
        "otype": "FullyFusedMLP" if fused else "VanillaMLP",
        "activation": "ReLU",
        "output_activation": "none",
        "n_neurons": width,
        "n_hidden_layers": depth,
    }
    texture = {
        "name": "volume-radiance",
        "input_feature_dim": features + 3,
        "dir_encoding_config": {"otype": "SphericalHarmonics", "degree": degree},
        "mlp_network_config": network,
        "color_activation": "sigmoid",
    }
    return state, texture, color_function(outputs, combine)


def _state(
    rng: np.random.Generator, network: Network, table: Tensor, radius: float, progressive: bool
) -> dict[str, Tensor]:
    prefix = "model.geometry.encoding.encoding."
    state = {f"{prefix}{'encoding.' if progressive else ''}params": table.detach().reshape(-1)}
    if progressive:
        state[f"{prefix}mask"] = torch.ones(1)
    layers = {}
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        factors = torch.tensor(rng.uniform(0.5, 2, len(weight)), dtype=torch.float32)
        parts = {"bias": bias.detach(), **normalized(weight, factors)}
        layers |= {f"model.geometry.network.layers.{2 * i}.{name}": part for name, part in parts.items()}
    state |= newer_names(layers) if rng.random() < 0.3 else layers
    if progressive:
        del state[f"{prefix}mask"]
    state["model.variance.variance"] = torch.tensor(0.4)
    box = torch.tensor([-radius] * 3 + [radius] * 3)
    return state | {"model.scene_aabb": box}


def _settings(layout: GridLayout, radius: float, sizes: tuple[int, int, int], mask: dict[str, int]) -> dict[str, Any]:
    hidden, depth, features = sizes
    encoding = {
        "otype": "ProgressiveBandHashGrid" if mask else "HashGrid",
        "n_levels": layout.levels,
        "n_features_per_level": layout.features,
        "log2_hashmap_size": layout.log2_size,
        "base_resolution": layout.base,
        "per_level_scale": layout.growth,
        "include_xyz": True,
        **mask,
    }
    network = {
        "otype": "VanillaMLP",
        "activation": "ReLU",
        "output_activation": "none",
        "n_neurons": hidden,
        "n_hidden_layers": depth,
        "sphere_init": True,
        "sphere_init_radius": 0.5,
        "weight_norm": True,
    }
    geometry = {
        "name": "volume-sdf",
        "radius": radius,
        "feature_dim": features,
        "grad_type": "analytic",
        "isosurface": {"method": "mc", "resolution": 512, "chunk": 2097152, "threshold": 0.0},
        "xyz_encoding_config": encoding,
        "mlp_network_config": network,
    }
    model = {"name": "neus", "radius": radius, "geometry": geometry, "variance": {"init_val": 0.3}}
    return {"name": "neus-thing", "tag": "", "seed": 42, "dataset": {"name": "blender"}, "model": model}
