"""The errors that a fit reports, of a field that is exact, on depths whose errors are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from regnf_data.posed_images import PosedImages
from regnf_fit.images.coloring import HeldOutErrors, evaluate
from regnf_fit.images.preparation import rays_of_pixels
from tests.fit.images import scenes

IMAGES = scenes.images(count=4, ball_alone=True)


class Ball:
    """The ball as a field."""

    def function(self) -> Ball:
        return self

    def value(self, points: Tensor) -> Tensor:
        return torch.from_numpy(scenes.ball_distance(points.double().numpy())).float()

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        outwards = points - torch.from_numpy(scenes.BALL_CENTER).float()
        return self.value(points), outwards / outwards.norm(dim=1, keepdim=True)


def errors(images: PosedImages) -> HeldOutErrors:
    field: Any = Ball()
    return evaluate(field, rays_of_pixels(images, np.arange(images.colors[..., 0].size), None), scenes.SIZE)


def with_left_half(depth: float) -> PosedImages:
    assert IMAGES.depths is not None
    depths = IMAGES.depths.copy()
    depths[:, :, : depths.shape[2] // 2] = depth
    return replace(IMAGES, depths=depths)


def test_an_exact_field_has_no_error() -> None:
    found = errors(IMAGES)
    assert found.depth_error is not None
    assert found.depth_error < 1e-3
    assert found.eikonal_error < 1e-5


def test_what_hides_the_thing_is_no_error_of_the_field() -> None:
    """A hand before the lens: the field is right about what is behind it."""
    hidden, seen = errors(with_left_half(0.1)), errors(IMAGES)
    assert hidden.depth_error == pytest.approx(seen.depth_error, rel=0.5)
    assert hidden.depth_error_median == pytest.approx(seen.depth_error_median, rel=0.5)


def test_a_surface_where_cameras_looked_through_is_an_error() -> None:
    found = errors(with_left_half(5.0))
    assert found.depth_error == pytest.approx(0.5 * (5.0 - 1.5), rel=0.25)
