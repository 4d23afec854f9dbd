"""The plain module and the evaluator: two ways to one field."""

from __future__ import annotations

from pathlib import Path

import torch

from benchmarks.robust.plain_field import PlainField
from regnf_core import open_field

ROOM = Path(__file__).parents[2] / "examples" / "data" / "mix-room.safetensors"


def test_both_evaluators_give_the_same_field() -> None:
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
    value, gradient = open_field(ROOM).signed_distance_and_gradient(points)
    plain_value, plain_gradient = PlainField(ROOM).value_and_gradient(points)
    assert torch.allclose(value, plain_value, atol=1e-5)
    assert torch.allclose(gradient, plain_gradient, atol=1e-3)
