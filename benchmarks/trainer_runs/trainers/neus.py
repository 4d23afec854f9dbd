"""NeuS: ``exp/<case>/<conf>/checkpoints/ckpt_*.pth`` with the configuration under ``recording/config.conf``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.trainer_runs.colors import Outputs, color_function, joined, random_layers
from benchmarks.trainer_runs.functions import Network, sines_by_frequency, sphere_network
from benchmarks.trainer_runs.run import ColorFunction, WrittenRun, normalized
from benchmarks.trainer_runs.shapes import random_shape
from benchmarks.trainer_runs.training import train


def write_neus(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """A run of random depth, width, skip layer, frequencies and scale."""
    said = _drawn_settings(rng)
    layers, hidden = said["n_layers"], said["d_hidden"]
    degree, scale = said["multires"], said["scale"]
    widths = [3 + 6 * degree, *[hidden] * layers, said["d_out"]]
    network = sphere_network(rng, widths, 3, said["skip_in"], said["bias"] * scale)

    def results(x: Tensor, net: Network = network) -> Tensor:
        scaled = x * scale
        return net(torch.cat((scaled, sines_by_frequency(scaled, degree)), dim=1))

    def value(x: Tensor, net: Network = network) -> Tensor:
        return results(x, net)[:, 0] / scale

    train(value, network.parameters(), random_shape(rng), rng, steps, 1e-3)
    state = {}
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        factors = torch.tensor(rng.uniform(0.5, 2, len(weight)), dtype=torch.float32)
        parts = normalized(weight, factors) if said["weight_norm"] else {"weight": weight.detach()}
        state |= {f"lin{i}.{name}": part for name, part in parts.items()}
        state[f"lin{i}.bias"] = bias.detach()
    net = network.double()

    def outputs(x: Tensor) -> Tensor:
        found = results(x, net)
        return torch.cat((found[:, :1] / scale, found[:, 1:]), dim=1)

    colors, rendering, color = _color(rng, said["d_out"] - 1, outputs)
    case = folder / "exp" / "thing" / "womask_sphere"
    iteration = int(rng.choice([50_000, 300_000]))
    checkpoint = case / "checkpoints" / f"ckpt_{iteration:06d}.pth"
    checkpoint.parent.mkdir(parents=True)
    content = {
        "nerf": {},
        "sdf_network_fine": state,
        "variance_network_fine": {"variance": torch.tensor(0.5)},
        "color_network_fine": colors,
        "optimizer": {"param_groups": [{"lr": np.float64(5e-4)}]},
        "iter_step": iteration,
    }
    torch.save(content, checkpoint)
    (case / "recording").mkdir()
    (case / "recording" / "config.conf").write_text(_conf(said, rendering))
    return WrittenRun(folder, checkpoint, said, lambda x: value(x, net), color=color)


def _drawn_settings(rng: np.random.Generator) -> dict[str, Any]:
    """The settings of the network of distances."""
    layers, hidden = int(rng.integers(4, 9)), int(rng.choice([64, 96, 128]))
    return {
        "d_out": int(rng.choice([1, 65, 129])),
        "d_in": 3,
        "d_hidden": hidden,
        "n_layers": layers,
        "skip_in": [int(rng.integers(2, layers))] if rng.random() < 0.8 else [],
        "multires": int(rng.choice([0, 4, 6, 8, 10])),
        "bias": float(rng.choice([0.3, 0.5, 0.6])),
        "scale": float(rng.choice([1.0, 1.0, 3.0, 2.0, 1.5, 0.5])),
        "geometric_init": True,
        "weight_norm": bool(rng.random() < 0.9),
    }


def _color(
    rng: np.random.Generator, features: int, outputs: Outputs
) -> tuple[dict[str, Tensor], dict[str, object], ColorFunction]:
    """A random color network: its state, its settings, its function."""
    mode = str(rng.choice(["idr", "idr", "no_normal", "no_view_dir"]))
    degree, depth = 0 if mode == "no_view_dir" else int(rng.choice([4, 4, 6, 2])), int(rng.integers(1, 5))
    seen = {"idr": 9, "no_normal": 6, "no_view_dir": 6}[mode] + 6 * degree
    layers = random_layers(rng, seen + features, int(rng.choice([48, 64])), depth)
    squeezed = bool(rng.random() < 0.8)

    def combine(x: Tensor, d: Tensor, gradient: Tensor, found: Tensor) -> Tensor:
        encoded = torch.cat((d, sines_by_frequency(d, degree)), dim=1)
        parts = {"idr": [x, encoded, gradient], "no_normal": [x, encoded], "no_view_dir": [x, gradient]}[mode]
        blue_green_red = layers(joined([*parts, found[:, 1:]]))
        return (torch.sigmoid(blue_green_red) if squeezed else blue_green_red).flip(1)

    said: dict[str, object] = {"d_feature": features, "mode": mode, "multires_view": degree, "squeeze_out": squeezed}
    return layers.state(rng, "lin", bool(rng.random() < 0.9)), said, color_function(outputs, combine)


def _conf(said: dict[str, object], rendering: dict[str, object]) -> str:
    lines, more = ("\n".join(f"        {key} = {entry}" for key, entry in part.items()) for part in (said, rendering))
    return f"""general {{
    base_exp_dir = ./exp/CASE_NAME/womask_sphere
    recording = [
        ./,
        ./models
    ]
}}
dataset {{
    data_dir = ./public_data/CASE_NAME/
    render_cameras_name = cameras_sphere.npz
}}
train {{
    learning_rate = 5e-4
    end_iter = 300000  # all of them
    use_white_bkgd = False
}}
model {{
    nerf {{
        D = 8,
        d_in = 4,
        skips=[4],
        use_viewdirs=True
    }}
    sdf_network {{
{lines}
    }}
    rendering_network {{
{more}
    }}
    variance_network {{
        init_val = 0.3
    }}
}}
"""
