"""A full-size field made of a small one has the small one's values."""

from __future__ import annotations

import itertools
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.enlarge import enlarge
from benchmarks.robust.library_objects import library_meshes
from regnf_core import open_field
from regnf_core.fields.mesh import MeshField
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.safe_format import read_description, write_safe_field
from tests.devdata import dev_data


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


# The 64 objects of the library search: no two are similar.


def shape_of(mesh: MeshField) -> NDArray[np.float64]:
    """Numbers that no rotation, shift or scale changes: main radii, spread of the distances to the middle, area."""
    points = mesh.sample_surface(3000, np.random.default_rng(0))
    points = points - points.mean(0)
    radii = np.sqrt(np.linalg.eigvalsh(np.cov(points.T)))
    distance = np.linalg.norm(points, axis=1)
    size = np.sqrt((distance**2).mean())
    spread = np.quantile(distance, [0.1, 0.25, 0.5, 0.75, 0.9])
    return np.concatenate([radii / size, spread / size, [np.sqrt(mesh.area) / size / 3.0]])


def test_there_are_64_objects_and_no_two_are_similar() -> None:
    objects = library_meshes(dev_data("furniture"))
    shapes = {name: shape_of(mesh) for name, mesh in objects}
    assert len(objects) == len(shapes) == 64
    least = min(np.abs(shapes[a] - shapes[b]).max() for a, b in itertools.combinations(shapes, 2))
    noise = max(
        np.abs(shape_of(mesh.transformed(np.diag([2.0, 2.0, 2.0, 1.0]))) - shapes[name]).max()
        for name, mesh in objects[:3]
    )
    assert noise < 1e-6
    assert least > 0.03
