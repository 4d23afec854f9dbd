"""NeuS: ``exp/<case>/<conf>/checkpoints/ckpt_*.pth`` with the configuration under ``recording/config.conf``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.trainer_runs.functions import Network, sines_by_frequency, sphere_network
from benchmarks.trainer_runs.run import WrittenRun, normalized
from benchmarks.trainer_runs.shapes import random_shape
from benchmarks.trainer_runs.training import train


def write_neus(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """A run of random depth, width, skip layer, frequencies and scale."""
    layers, hidden = int(rng.integers(4, 9)), int(rng.choice([64, 96, 128]))
    said = {
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
    degree, scale = said["multires"], said["scale"]
    widths = [3 + 6 * degree, *[hidden] * layers, said["d_out"]]
    network = sphere_network(rng, widths, 3, said["skip_in"], said["bias"] * scale)

    def value(x: Tensor, net: Network = network) -> Tensor:
        scaled = x * scale
        return net(torch.cat((scaled, sines_by_frequency(scaled, degree)), dim=1))[:, 0] / scale

    train(value, network.parameters(), random_shape(rng), rng, steps, 1e-3)
    state = {}
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        factors = torch.tensor(rng.uniform(0.5, 2, len(weight)), dtype=torch.float32)
        parts = normalized(weight, factors) if said["weight_norm"] else {"weight": weight.detach()}
        state |= {f"lin{i}.{name}": part for name, part in parts.items()}
        state[f"lin{i}.bias"] = bias.detach()
    case = folder / "exp" / "thing" / "womask_sphere"
    iteration = int(rng.choice([50_000, 300_000]))
    checkpoint = case / "checkpoints" / f"ckpt_{iteration:06d}.pth"
    checkpoint.parent.mkdir(parents=True)
    content = {
        "nerf": {},
        "sdf_network_fine": state,
        "variance_network_fine": {"variance": torch.tensor(0.5)},
        "color_network_fine": {"lin0.bias": torch.zeros(4)},
        "optimizer": {"param_groups": [{"lr": np.float64(5e-4)}]},
        "iter_step": iteration,
    }
    torch.save(content, checkpoint)
    (case / "recording").mkdir()
    (case / "recording" / "config.conf").write_text(_conf(said))
    net = network.double()
    return WrittenRun(folder, checkpoint, said, lambda x: value(x, net))


def _conf(said: dict[str, object]) -> str:
    lines = "\n".join(f"        {key} = {entry}" for key, entry in said.items())
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
    variance_network {{
        init_val = 0.3
    }}
}}
"""
