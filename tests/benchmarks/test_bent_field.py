"""The field with random errors: its gradient against differences, its errors' size and correlation."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from benchmarks.robust.bent_field import BentField
from benchmarks.robust.plain_field import PlainField
from benchmarks.solids import BoxField
from regnf_core import open_field

BOX = BoxField((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3))


def places(count: int, seed: int = 0) -> Tensor:
    return 4.0 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) - 2.0


def test_the_gradient_is_that_of_the_value() -> None:
    field = BentField(BOX, amplitude=0.05, length=0.2, seed=3)
    points, step = places(200), 1e-3
    value, gradient = field.signed_distance_and_gradient(points)
    assert torch.equal(value, field.signed_distance(points))
    _, plain = BOX.signed_distance_and_gradient(points)
    for axis in range(3):
        aside = torch.zeros(3)
        aside[axis] = step
        bend = [field.signed_distance(p) - BOX.signed_distance(p) for p in (points + aside, points - aside)]
        slope = (bend[0] - bend[1]) / (2 * step)
        assert torch.allclose(gradient[:, axis] - plain[:, axis], slope, atol=2e-3)
        assert slope.abs().max() > 0.1


# The plain module and the evaluator: two ways to one field.

ROOM = Path(__file__).parents[2] / "examples" / "data" / "mix-room.safetensors"


def test_both_evaluators_give_the_same_field() -> None:
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
    value, gradient = open_field(ROOM).signed_distance_and_gradient(points)
    plain_value, plain_gradient = PlainField(ROOM).value_and_gradient(points)
    assert torch.allclose(value, plain_value, atol=1e-5)
    assert torch.allclose(gradient, plain_gradient, atol=1e-3)
