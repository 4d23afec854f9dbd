"""The derivatives of the residuals as lengths of the scene, by two routes, in several frames and at several scales."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.residuals import SurfacePair, residuals
from regnf_core.robust.working_frame import Samples
from tests.core.robust.shapes import random_pose

SCALES = [0.05, 1.0, 20.0]


class Quadric:
    """A smooth, curved made-up distance in float64, so that derivatives can be compared to many digits."""

    def __init__(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.M = torch.randn(3, 3, generator=generator, dtype=torch.float64)
        self.b = torch.randn(3, generator=generator, dtype=torch.float64)

    def value(self, points: Tensor) -> Tensor:
        return (points @ self.M).sin().sum(-1) + points @ self.b

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        gradient = (points @ self.M).cos() @ self.M.T + self.b
        return self.value(points), gradient


def samples(field: Quadric, seed: int) -> Samples:
    points = torch.randn(9, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    value, gradient = field.value_and_gradient(points)
    return Samples(points, value, gradient / gradient.norm(dim=-1, keepdim=True))


def plain_residuals(scene: Quadric, obj: Quadric, A: Samples, B: Samples, T: Sim3) -> Tensor:
    """The definition, written out once more: S_b(T x) - s S_a(x), then s S_a(T^-1 z) - S_b(z)."""
    scene_to_object = obj.value(T.apply(A.points)) - T.scale * scene.value(A.points)
    object_to_scene = T.scale * scene.value(T.inverse().apply(B.points)) - obj.value(B.points)
    return torch.cat([scene_to_object, object_to_scene])


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("frame", [0, 1, 2])
def test_the_jacobian_is_what_autograd_says(scale: float, frame: int) -> None:
    scene, obj, T = Quadric(frame), Quadric(frame + 10), random_pose(frame, scale)
    A, B = samples(scene, 3), samples(obj, 4)

    def moved(step: Tensor) -> Tensor:
        p = T[None].perturb(step[None])
        in_object = plain_residuals(scene, obj, A, B, Sim3(p.scale[0], p.rotation[0], p.translation[0]))
        return in_object / p.scale[0] * T.scale

    expected = torch.autograd.functional.jacobian(moved, torch.full((7,), 1e-12, dtype=torch.float64))
    found = residuals(SurfacePair(scene, obj, A, B), T[None])
    torch.testing.assert_close(found.values[0], plain_residuals(scene, obj, A, B, T), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found.jacobian[0], expected, rtol=1e-6, atol=1e-6)


def test_true_pose_leaves_no_residual_off_the_surface_at_any_scale() -> None:
    scene, T = Quadric(0), random_pose(5, 7.0)

    class SeenFromObject:
        def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
            value, gradient = scene.value_and_gradient(T.inverse().apply(points))
            return T.scale * value, gradient @ T.rotation.T

    obj = SeenFromObject()
    A = samples(scene, 1)
    z = T.apply(A.points)
    value, gradient = obj.value_and_gradient(z)
    B = Samples(z, value, gradient / gradient.norm(dim=-1, keepdim=True))
    found = residuals(SurfacePair(scene, obj, A, B), T[None])
    assert found.values.abs().max() < 1e-9
    torch.testing.assert_close(found.cosines, torch.ones_like(found.cosines))
