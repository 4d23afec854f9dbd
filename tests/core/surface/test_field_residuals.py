"""Residuals between two fields: with the scale, and with the sign that tells missing matter from too much."""

from __future__ import annotations

import pytest
import torch

from regnf_core.geometry.sim3 import Sim3
from regnf_core.surface.result_clouds import object_residuals, scene_residuals
from tests.core.analytic import sphere


def test_residuals_keep_the_scale() -> None:
    # The same ball in units twice as small: exact agreement everywhere, on the surface and off it.
    T = Sim3.from_quaternion(2.0, [0, 0, 0, 1], [0.1, 0, 0])
    small, large = sphere(0.2), sphere(0.4, (0.1, 0, 0))
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    assert float(scene_residuals(small, large, points, T).abs().max()) < 1e-6
    assert float(object_residuals(small, large, points, T).abs().max()) < 1e-6


def test_the_sign_tells_missing_matter_from_too_much() -> None:
    on_large = torch.tensor([[0.0, 0.4, 0.0]])
    assert float(object_residuals(sphere(0.3), sphere(0.4), on_large, Sim3.identity())) == pytest.approx(0.1, abs=1e-6)
    on_small = torch.tensor([[0.0, 0.3, 0.0]])
    assert float(object_residuals(sphere(0.4), sphere(0.3), on_small, Sim3.identity())) == pytest.approx(-0.1, abs=1e-6)
