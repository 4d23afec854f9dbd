"""MonoSDF: ``exps/<name>/<time>/checkpoints/ModelParameters/*.pth`` with ``runconf.conf`` beside them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.trainer_runs.functions import Network, sines_by_frequency, sphere_network
from benchmarks.trainer_runs.run import WrittenRun
from benchmarks.trainer_runs.shapes import random_shape
from benchmarks.trainer_runs.trainers.implicit import implicit_state
from benchmarks.trainer_runs.trainers.kernel_grid import KernelGrid, kernel_features, new_kernel_table
from benchmarks.trainer_runs.training import train

_DEFAULTS = KernelGrid(levels=16, features=2, log2_size=19, base=16, top=2048, smoothstep=True)
_KEYS = {"num_levels": "levels", "level_dim": "features", "logmap": "log2_size", "base_size": "base", "end_size": "top"}


def write_monosdf(folder: Path, rng: np.random.Generator, steps: int) -> WrittenRun:
    """A run with a grid, or with the grid's columns and zeros in them; what is the trainer's default is left out."""
    grid = _random_grid(rng)
    uses, room = bool(rng.random() < 0.75), bool(rng.random() < 0.4)
    depth = int(rng.choice([1, 2, 2, 3, 4, 8]))
    said: dict[str, Any] = {
        "d_in": 3,
        "d_out": 1,
        "dims": [int(rng.choice([32, 64, 128]))] * depth,
        "geometric_init": True,
        "bias": float(rng.choice([0.6, 0.9, 0.5])),
        "skip_in": [int(rng.choice([2, 3, 4]))],
        "weight_norm": bool(rng.random() < 0.9),
        "multires": int(rng.choice([6, 6, 4, 7, 0])),
        "use_grid_feature": uses,
    }
    if room:
        said["inside_outside"] = True
    divisor = float(rng.choice([1.0, 1.1, 1.5, 1.5, 2.0, 1.3, 5.0]))
    if divisor != 1.5 or rng.random() < 0.5:
        said["divide_factor"] = divisor
    said |= {key: getattr(grid, name) for key, name in _KEYS.items() if getattr(grid, name) != getattr(_DEFAULTS, name)}
    return _write(folder, rng, steps, said, (grid, divisor))


def _random_grid(rng: np.random.Generator) -> KernelGrid:
    base, levels = int(rng.choice([16, 16, 8, 32])), int(rng.integers(4, 17))
    top = base * int(rng.choice([4, 8, 16, 20, 32]))
    return KernelGrid(levels, int(rng.choice([2, 2, 4, 1])), int(rng.integers(10, 15)), base, top, True)


def _write(
    folder: Path, rng: np.random.Generator, steps: int, said: dict[str, Any], grid: tuple[KernelGrid, float]
) -> WrittenRun:
    layout, divisor = grid
    features, degree, uses = int(rng.choice([0, 64])), said["multires"], said["use_grid_feature"]
    widths = [3 + 6 * degree + layout.levels * layout.features, *said["dims"], said["d_out"] + features]
    if widths[0] >= widths[1]:
        said["skip_in"] = []  # the layer before a skip makes way for the input
    skips = [i for i in said["skip_in"] if i <= len(said["dims"])]
    network, table = sphere_network(rng, widths, 3, skips, said["bias"]), new_kernel_table(rng, layout)
    side = -1.0 if said.get("inside_outside") else 1.0

    def value(x: Tensor, net: Network = network, entries: Tensor = table) -> Tensor:
        grown = kernel_features(layout, entries, (x / divisor + 1) / 2)
        return net(torch.cat((x, sines_by_frequency(x, degree), grown if uses else grown * 0), dim=1))[:, 0]

    shape = random_shape(rng)
    train(lambda x: side * value(x), [*network.parameters(), table], shape, rng, steps, 3e-3)
    prefix = str(rng.choice(["", "module."])) + "implicit_network."
    state = implicit_state(rng, network, prefix, said["weight_norm"])
    state[f"{prefix}encoding.embeddings"] = table.detach()
    starts = np.concatenate(([0], np.cumsum(layout.counts())))
    state[f"{prefix}encoding.offsets"] = torch.tensor(starts, dtype=torch.int32)
    state["module.density.beta" if prefix.startswith("module") else "density.beta"] = torch.tensor(0.05)
    time = folder / "exps" / "thing_1" / "2022_03_01_10_20_30"
    checkpoint = time / "checkpoints" / "ModelParameters" / "latest.pth"
    checkpoint.parent.mkdir(parents=True)
    torch.save({"epoch": 200, "model_state_dict": state}, checkpoint)
    (time / "runconf.conf").write_text(_conf(said, features, max(divisor, 1.0)))
    net, entries = network.double(), table.detach().double()
    reach = 0.95 / math.sqrt(3) if divisor < 1 else 0.95
    return WrittenRun(folder, checkpoint, {**said, "grid": layout}, lambda x: value(x, net, entries), reach)


def _conf(said: dict[str, Any], features: int, sphere: float) -> str:
    lines = "\n".join(f"        {key} = {entry}" for key, entry in said.items())
    return f"""train{{
    expname = thing
    dataset_class = datasets.scene_dataset.SceneDatasetDN
    lr_factor_for_grid = 20.0
}}
plot{{
    grid_boundary = [-1.1, 1.1]
}}
model{{
    feature_vector_size = {features}
    scene_bounding_sphere = {sphere}

    Grid_MLP = True

    implicit_network
    {{
{lines}
    }}
    rendering_network
    {{
        mode = idr
        per_image_code = True
    }}
    density
    {{
        params_init{{
            beta = 0.1
        }}
    }}
}}
"""
