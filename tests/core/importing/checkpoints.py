"""Checkpoints as sdfstudio's trainer writes them: the geometry of a sphere, and all that lies about in such files."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from regnf_core.schema.hash_grid_config import HashGridConfig

LEVELS, FEATURES = 16, 2
Change = Callable[[dict[str, Any]], None]


def write_full_size_checkpoint(path: Path, log2_size: int = 19, optimizer: bool = True) -> None:
    """A checkpoint of a real run's size: 2^log2_size entries a level, 256 wide; with Adam's state about 150 MB."""
    torch.save(checkpoint(log2_size, hidden=256, optimizer=optimizer), path)


def write_small_checkpoint(
    path: Path,
    log2_size: int = 8,
    hidden: int = 64,
    radius: float = 0.5,
    prefix: str = "_model.field.",
    change: Change | None = None,
) -> None:
    """A checkpoint of some tens of kilobytes. ``change`` may alter the dictionary before it is written."""
    values = checkpoint(log2_size, hidden, radius, prefix)
    if change is not None:
        change(values)
    torch.save(values, path)


def checkpoint(
    log2_size: int = 8, hidden: int = 64, radius: float = 0.5, prefix: str = "_model.field.", optimizer: bool = True
) -> dict[str, Any]:
    """The dictionary that sdfstudio's trainer saves."""
    field = {prefix + name: value for name, value in field_state(log2_size, hidden, radius).items()}
    pipeline = OrderedDict({"datamanager.train_ray_generator.image_coords": torch.zeros(4, 4, 2)})
    pipeline |= field
    pipeline["_model.lpips.net.lin0.model.1.weight"] = torch.ones(1, 4, 1, 1)
    pipeline["_model.proposal_networks.0.mlp_base.params"] = torch.ones(64)
    rate = np.float64(2.7e-4)
    return {
        "step": 30000,
        "pipeline": pipeline,
        "optimizers": {"fields": _adam(list(field.values()), rate)} if optimizer else {},
        "schedulers": {"fields": {"base_lrs": [5e-4], "last_epoch": 30000, "_last_lr": [rate]}},
        "scalers": {"scale": 65536.0, "growth_factor": 2.0},
    }


def field_state(log2_size: int, hidden: int, radius: float) -> dict[str, Tensor]:
    """The field's own tensors: a geometric initialization (Atzmon and Lipman 2020), so a sphere, and some noise."""
    generator = torch.Generator().manual_seed(7)

    def normal(rows: int, columns: int, mean: float, deviation: float) -> Tensor:
        return mean + deviation * torch.randn(rows, columns, generator=generator)

    grid = HashGridConfig(levels=LEVELS, features_per_level=FEATURES, log2_table_size=log2_size)
    inputs = 3 + 36 + grid.width
    first = torch.zeros(hidden, inputs)
    first[:, :3] = normal(hidden, 3, 0.0, math.sqrt(2 / hidden))
    first[:, 3:] = normal(hidden, inputs - 3, 0.0, 1e-4)
    weights = [
        first,
        normal(hidden, hidden, 0.0, math.sqrt(2 / hidden)),
        normal(hidden + 1, hidden, math.sqrt(math.pi / hidden), 1e-4),
    ]
    biases = [torch.zeros(hidden), torch.zeros(hidden), torch.full((hidden + 1,), -radius)]
    table = 1e-4 * (2 * torch.rand(grid.entries * FEATURES, generator=generator) - 1)
    state = {"aabb": torch.tensor([[-1.0] * 3, [1.0] * 3]), "encoding.params": table}
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        state[f"glin{layer}.bias"] = bias
        state[f"glin{layer}.weight_g"] = weight.norm(dim=1, keepdim=True)
        state[f"glin{layer}.weight_v"] = weight
    state["laplace_density.beta"] = torch.tensor([0.1])
    state["deviation_network.variance"] = torch.tensor([0.3])
    return state | color_state(generator, hidden)


def color_state(generator: torch.Generator, features: int, width: int = 8, images: int = 5) -> dict[str, Tensor]:
    """The color network's tensors: position, direction, gradient, features, appearance -> width -> R, G, B."""
    columns = 3 + 27 + 3 + features + 32
    state = {"embedding_appearance.embedding.weight": torch.randn(images, 32, generator=generator)}
    for layer, (rows, wide) in enumerate([(width, columns), (3, width)]):
        weight = torch.randn(rows, wide, generator=generator) / math.sqrt(wide)
        state[f"clin{layer}.bias"] = torch.zeros(rows)
        state[f"clin{layer}.weight_g"] = weight.norm(dim=1, keepdim=True)
        state[f"clin{layer}.weight_v"] = weight
    return state


def _adam(parameters: list[Tensor], rate: Any) -> dict[str, Any]:
    """Adam's state, as large again as the parameters, twice."""
    state = {
        i: {"step": torch.tensor(30000.0), "exp_avg": torch.zeros_like(p), "exp_avg_sq": torch.zeros_like(p)}
        for i, p in enumerate(parameters)
    }
    return {"state": state, "param_groups": [{"lr": rate, "betas": (0.9, 0.999), "params": list(state)}]}
