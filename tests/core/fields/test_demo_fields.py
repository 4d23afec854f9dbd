"""The demo's fields agree with each other under the true transform that lies beside them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from regnf_core.fields.build import open_field
from regnf_core.fields.observation import SdfField

DATA = Path(__file__).resolve().parents[3] / "examples" / "data"


def surface_points(field: SdfField, count: int = 4000) -> torch.Tensor:
    """Points on the field's zero level, carried down its gradient from random ones."""
    lower, upper = field.bounds.float()
    points = lower + (upper - lower) * torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    for _ in range(8):
        distance, gradient = field.signed_distance_and_gradient(points)
        points = points - distance[:, None] * gradient / gradient.square().sum(dim=1, keepdim=True).clamp_min(0.25)
    arrived: torch.Tensor = points[field.signed_distance(points).abs() < 1e-4]
    return arrived


@pytest.mark.parametrize(("name", "suffix"), [("armchair", ""), ("dining-chair", "-dining-chair")])
def test_object_lies_in_the_scene_where_the_truth_says(name: str, suffix: str) -> None:
    truth = json.loads((DATA / f"truth{suffix}.json").read_text())
    detection = json.loads((DATA / f"detection{suffix}.json").read_text())
    scene, chair = open_field(DATA / "mix-room.safetensors"), open_field(DATA / f"{name}.safetensors")
    points = surface_points(chair)
    assert len(points) > 2000
    T_object_scene = torch.tensor(truth["T_object_scene"]["matrix"], dtype=torch.float64)
    scale = truth["T_object_scene"]["scale"]
    assert scale == 1.25
    T_scene_object = T_object_scene.inverse()
    in_scene = points.double() @ T_scene_object[:3, :3].T + T_scene_object[:3, 3]
    residual = scale * scene.signed_distance(in_scene.float()).abs() / truth["object_diameter"]
    assert residual.mean() < 0.003
    assert residual.quantile(0.95) < 0.01
    center, size = torch.tensor(detection["center"]), torch.tensor(detection["size"])
    assert ((in_scene - center).abs() <= 0.51 * size + 0.005).all()
    assert points.abs().max() <= 0.5


def test_the_files_stay_small() -> None:
    sizes = [path.stat().st_size for path in DATA.glob("*.safetensors")]
    assert max(sizes) < 5e6
    assert sum(sizes) < 9e6
