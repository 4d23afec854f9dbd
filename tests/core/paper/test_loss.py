"""The bidirectional loss on spheres, where everything can be worked out by hand; gradients by finite differences."""

from __future__ import annotations

import pytest
import torch

from regnf_core.geometry.sim3 import Sim3
from regnf_core.paper.optimization import (
    AdaptiveKernel,
    SampleSet,
    bidirectional_loss,
    log_partition,
    regularizer,
    residuals,
    robust_kernel,
)
from tests.core.analytic import chair, chair_pose, room, sphere

DOUBLED = Sim3.from_quaternion(2.0, [0, 0, 0, 1], [0.1, 0.0, 0.0])


def test_residuals_as_published_leave_out_the_scale() -> None:
    small, large = sphere(0.2), sphere(0.4)
    # 0.05 outside the small ball: x = 0.25 goes to 0.6 = 0.1 + 2 * 0.25, which is 0.2 outside the large one.
    samples = SampleSet.of(small, torch.tensor([[0.25, 0.0, 0.0]]))
    assert float(residuals(samples, large, DOUBLED)) == pytest.approx(0.2 - 0.05, abs=1e-6)
    # z = 0.5 goes back to (0.5 - 0.1) / 2 = 0.2, on the small ball; it is 0.1 outside the large one.
    back = SampleSet.of(large, torch.tensor([[0.5, 0.0, 0.0]]))
    assert float(residuals(back, small, DOUBLED.inverse())) == pytest.approx(0.1, abs=1e-6)


def test_regularizer_is_the_mean_squared_distance_to_the_nearest_sample() -> None:
    target = SampleSet.of(sphere(0.4), torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    moved = torch.tensor([[0.1, 0.0, 0.0], [0.9, 0.2, 0.0]])
    assert float(regularizer(moved, target)) == pytest.approx((0.01 + 0.05) / 2)


def test_loss_is_the_sum_of_its_parts() -> None:
    small, large = sphere(0.2), sphere(0.4)
    A = SampleSet.of(small, torch.tensor([[0.25, 0.0, 0.0], [0.0, 0.2, 0.0]]))
    B = SampleSet.of(large, torch.tensor([[0.5, 0.0, 0.0]]))
    kernel = AdaptiveKernel()
    terms = bidirectional_loss(small, large, A, B, DOUBLED, kernel, 3.0)
    shape = kernel.shape.detach()
    kappa = [robust_kernel(r.double(), shape, 1.0).mean() for r in (terms.residuals_scene, terms.residuals_object)]
    normalizer = log_partition(shape)  # log p = 0 at the start
    expected = sum(kappa) + 2 * normalizer + 3.0 * terms.regularizer
    assert float(terms.total.detach()) == pytest.approx(float(expected), abs=1e-6)


def test_gradient_reaches_every_learned_number_and_is_right() -> None:
    # Balls off the origin: smooth fields, so that finite differences mean something, and no free rotation.
    scene, obj = sphere(0.2, (0.1, 0.2, 0.0)), sphere(0.3, (-0.1, 0.05, 0.1))
    generator = torch.Generator().manual_seed(0)
    A = SampleSet.of(scene, torch.rand(60, 3, generator=generator))
    B = SampleSet.of(obj, torch.rand(60, 3, generator=generator) - 0.9)
    kernel = AdaptiveKernel()
    at = torch.tensor([0.5, -0.3, 0.4, 0.3, -0.2, 0.1, 0.2], dtype=torch.float64)

    def loss(tangent: torch.Tensor) -> torch.Tensor:
        return bidirectional_loss(scene, obj, A, B, Sim3.exp(tangent), kernel, 1.0).total

    tangent = at.clone().requires_grad_()
    loss(tangent).backward()  # type: ignore[no-untyped-call]
    assert tangent.grad is not None
    assert kernel.latents.grad is not None
    step = 1e-3  # the fields compute in float32
    for k in range(7):
        shift = torch.zeros(7, dtype=torch.float64)
        shift[k] = step
        slope = float((loss(at + shift) - loss(at - shift)).detach()) / (2 * step)
        assert float(tangent.grad[k]) == pytest.approx(slope, abs=2e-3 * float(tangent.grad.norm()))
    assert bool((kernel.latents.grad != 0).all())


def test_loss_is_least_at_the_truth() -> None:
    T = chair_pose(scale=1.0)
    scene, obj = room(T), chair()
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    on = points[obj.signed_distance(points).abs() < 0.02]
    B = SampleSet.of(obj, on)
    A = SampleSet.of(scene, T.inverse().apply(on))
    kernel = AdaptiveKernel()

    def loss(transform: Sim3) -> float:
        return float(bidirectional_loss(scene, obj, A, B, transform, kernel, 1.0).total.detach())

    best = loss(T)
    for k in range(7):
        for sign in (-1.0, 1.0):
            tangent = torch.zeros(7, dtype=torch.float64)
            tangent[k] = sign * 0.05
            assert loss(Sim3.exp(tangent) @ T) > best + 1e-5
