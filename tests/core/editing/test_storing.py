"""Edited scenes as files: distances and colors at the nodes of a grid."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from regnf_core import Sim3, Substitution, compose, open_field
from regnf_core.editing.storing import write_field
from regnf_core.fields.observation import has_color
from tests.core.analytic import AnalyticField, sphere

RED, BLUE = torch.tensor([0.9, 0.2, 0.1]), torch.tensor([0.1, 0.3, 0.8])
RADIUS = 0.4


class TwoColored(AnalyticField):
    """A ball, red where z is positive and blue elsewhere, and black where it is not seen from straight before."""

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        straight = -(torch.nn.functional.normalize(points, dim=-1) * directions).sum(-1) > 0.99
        halves = torch.where(points[:, 2:] > 0.0, RED, BLUE)
        return torch.where(straight[:, None], halves, 0.0)

    inverse_deviation = None


def ball() -> TwoColored:
    made = sphere(RADIUS)
    return TwoColored(made.formula, made.bounds.tolist())


def on_the_ball(count: int = 500) -> Tensor:
    directions = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    points = RADIUS * torch.nn.functional.normalize(directions, dim=-1)
    return points[points[:, 2].abs() > 0.1]  # off the border between the halves


@pytest.mark.parametrize("edited", [False, True])
def test_a_field_keeps_its_colors(edited: bool, tmp_path: Path) -> None:
    """Also those of what was put in, at another scale and place."""
    field, at = ball(), on_the_ball()
    if edited:
        T = Sim3.exp(torch.tensor([0.4, 0.0, 0.0, 0.1, -0.05, 0.02, 0.3], dtype=torch.float64))
        back = T.inverse()
        scene = sphere(float(RADIUS / T.scale), back.apply(torch.zeros(1, 3).double())[0].tolist())
        field, at = compose(scene, [Substitution(field, T)]), back.apply(at.double()).float()
    write_field(field, tmp_path / "f.safetensors", 48)
    stored = open_field(tmp_path / "f.safetensors")
    assert has_color(stored)
    expected = torch.where(on_the_ball()[:, 2:] > 0.0, RED, BLUE)
    found = stored.color(at, torch.zeros_like(at))
    assert (found - expected).abs().max() < 0.01
    assert stored.signed_distance(at).abs().max() < 0.02


def test_a_field_without_colors_stays_without(tmp_path: Path) -> None:
    write_field(sphere(RADIUS), tmp_path / "f.safetensors", 16)
    assert not has_color(open_field(tmp_path / "f.safetensors"))
