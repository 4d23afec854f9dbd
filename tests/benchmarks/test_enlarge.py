"""A full-size field made of a small one has the small one's values."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from benchmarks.enlarge import enlarge
from regnf_core import open_field
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.safe_format import read_description, write_safe_field


def test_values_and_gradients_are_the_same(tmp_path: Path) -> None:
    small = HashGridConfig(levels=6, features_per_level=2, log2_table_size=12, base_resolution=8, per_level_scale=1.6)
    random = np.random.default_rng(0)
    width = 3 + 36 + small.width
    shapes = {
        "hash_table": (small.entries, 2),
        "layers.0.weight": (32, width), "layers.0.bias": (32,),
        "layers.1.weight": (32, 32), "layers.1.bias": (32,),
        "layers.2.weight": (1, 32), "layers.2.bias": (1,),
    }  # fmt: skip
    tensors = {name: random.normal(scale=0.3, size=shape).astype(np.float32) for name, shape in shapes.items()}
    description = {
        "kind": "neus_facto",
        "bounds": [[-1.0] * 3, [1.0] * 3],
        "hash": asdict(small),
        "positional_encoding": {"degree": 6},
    }
    write_safe_field(tmp_path / "small.safetensors", description, tensors)
    enlarge(tmp_path / "small.safetensors", tmp_path / "large.safetensors")
    grid = read_description(tmp_path / "large.safetensors")["hash"]
    assert (grid["levels"], grid["log2_table_size"]) == (16, 19)
    points = 2.0 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(1)) - 1.0
    expected = open_field(tmp_path / "small.safetensors").signed_distance_and_gradient(points)
    found = open_field(tmp_path / "large.safetensors").signed_distance_and_gradient(points)
    torch.testing.assert_close(found[0], expected[0], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(found[1], expected[1], rtol=1e-4, atol=1e-4)
