"""The optimization of the published method: kernel, loss, resampling."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import ResamplingOptions
from regnf_core.paper.optimization import (
    SHAPE_RANGE,
    AdaptiveKernel,
    SampleSet,
    bidirectional_loss,
    field_radius,
    log_partition,
    regularizer,
    resample,
    residuals,
    robust_kernel,
)
from tests.core.analytic import chair, chair_pose, room, sphere

# Barron's kernel: hand-computed values, limits, the normalizer by an independent quadrature, what learning does.

R = torch.tensor([0.0, 1.0, -1.0, 3.0], dtype=torch.float64)


@pytest.mark.parametrize(
    ("residual", "shape", "scale", "expected"),
    [
        (1.0, 1.0, 1.0, math.sqrt(2) - 1),  # Charbonnier: sqrt(x^2 + 1) - 1
        (-2.0, 1.0, 2.0, math.sqrt(2) - 1),  # only |r / p| counts
        (3.0, 1.0, 1.0, math.sqrt(10) - 1),
        (0.0, 0.5, 1.0, 0.0),
        # alpha 1/2: gap 1.5, gap / alpha = 3; x^2 = 1.5 * 15 makes the bracket (15 + 1)^(1/4) - 1 = 1.
        (math.sqrt(22.5), 0.5, 1.0, 3.0),
    ],
)
def test_values_by_hand(residual: float, shape: float, scale: float, expected: float) -> None:
    value = robust_kernel(torch.tensor(residual, dtype=torch.float64), shape, scale)
    assert float(value) == pytest.approx(expected, abs=1e-12)


def test_small_shapes_tend_to_cauchy() -> None:
    # The limit for alpha -> 0 is log(x^2 / 2 + 1).
    torch.testing.assert_close(robust_kernel(R, 1e-6, 1.0), torch.log1p(R**2 / 2), rtol=1e-5, atol=1e-9)


def test_small_residuals_are_squared_whatever_the_shape() -> None:
    x = torch.tensor([1e-4], dtype=torch.float64)
    for shape in (0.01, 0.5, 1.0):
        torch.testing.assert_close(robust_kernel(x, shape, 1.0), x**2 / 2, rtol=1e-6, atol=0)


def test_gradient_against_finite_differences() -> None:
    inputs = tuple(torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in ([0.3, -2.0], 0.4, 0.7))
    assert torch.autograd.gradcheck(robust_kernel, inputs)


@pytest.mark.parametrize("shape", [0.001, 0.05, 0.3, 0.7, 0.999])
def test_partition_by_another_quadrature(shape: float) -> None:
    def density(u: float) -> float:
        x = math.sinh(u)
        rho = (2 - shape) / shape * math.expm1(shape / 2 * math.log1p(x * x / (2 - shape)))
        return math.exp(math.log(math.cosh(u)) - rho)

    expected, _ = quad(density, 0.0, 40.0, limit=500, epsabs=1e-12)
    assert float(log_partition(torch.tensor(shape, dtype=torch.float64))) == pytest.approx(
        math.log(2 * expected), abs=1e-7
    )


def test_partition_gradient_against_finite_differences() -> None:
    assert torch.autograd.gradcheck(log_partition, (torch.tensor(0.5, dtype=torch.float64, requires_grad=True),))


def test_starts_at_scale_one_and_mid_shape_and_cannot_leave_the_ranges() -> None:
    kernel = AdaptiveKernel()
    assert float(kernel.scale.detach()) == pytest.approx(1.0)
    assert float(kernel.shape.detach()) == pytest.approx(sum(SHAPE_RANGE) / 2)
    for latent in (-1e3, 1e3):
        with torch.no_grad():
            kernel.latents.fill_(latent)
        assert SHAPE_RANGE[0] <= float(kernel.shape.detach()) <= SHAPE_RANGE[1]
        assert float(kernel.scale.detach()) > 0


def _learn(residuals: torch.Tensor) -> AdaptiveKernel:
    kernel = AdaptiveKernel()
    adam = torch.optim.Adam([kernel.latents], lr=0.05)
    for _ in range(250):
        adam.zero_grad()
        kernel.negative_log_likelihood((residuals,)).backward()  # type: ignore[no-untyped-call]
        adam.step()
    return kernel


def test_learning_finds_the_scale_of_the_residuals_and_the_weight_of_their_tails() -> None:
    generator = np.random.default_rng(0)
    normal = _learn(torch.tensor(generator.normal(0, 0.1, 2000)))
    heavy = _learn(torch.tensor(0.1 * generator.standard_cauchy(2000)))
    assert float(normal.shape.detach()) > 0.9  # as near to Gaussian as the range allows
    assert float(heavy.shape.detach()) < 0.2
    # A Cauchy density with half width g is exp(-rho) at alpha 0 with x^2 / (2 p^2) = x^2 / g^2: p = g / sqrt 2.
    assert float(heavy.scale.detach()) == pytest.approx(0.1 / math.sqrt(2), rel=0.15)


# The bidirectional loss on spheres, where everything can be worked out by hand; gradients by finite differences.

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


# Algorithm 1: every accepted sample meets the paper's four conditions, checked by a slow reference.

OPTIONS = ResamplingOptions()
IDENTITY = Sim3.identity()


def ball_samples(count: int) -> SampleSet:
    directions = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return SampleSet.of(sphere(0.3), 0.3 * torch.nn.functional.normalize(directions, dim=1))


def test_accepted_samples_meet_all_four_conditions() -> None:
    old = ball_samples(300)
    own, other = sphere(0.3), sphere(0.305, (0.004, 0.0, 0.0))
    new = resample(old, own, other, IDENTITY, OPTIONS, torch.Generator().manual_seed(1))
    assert torch.equal(new.points[:300], old.points)  # nothing old is lost while there is room
    fresh = new.points[300:]
    assert len(fresh) > 20
    rho = 0.05 * field_radius(own)
    assert rho == 0.05
    for x in fresh:
        s_own = float(x.norm()) - 0.3
        s_other = float((x - torch.tensor([0.004, 0.0, 0.0])).norm()) - 0.305
        assert abs(s_own) <= 0.01 + 1e-6
        assert abs(s_other) <= 0.02 + 1e-6
        assert abs(s_own - s_other) <= 0.02 + 1e-6
        distances = (old.points - x).norm(dim=1)
        assert float(distances.min()) >= rho / 10 - 1e-6
        assert float((old.points - x).abs().amax(1).min()) <= rho + 1e-6  # shaken from one of the old ones
    torch.testing.assert_close(new.own_distance, own.signed_distance(new.points))


def test_nothing_is_accepted_where_the_other_surface_is_not_and_the_transform_carries_samples_there() -> None:
    old = ball_samples(200)
    far = resample(old, sphere(0.3), sphere(0.3, (0.9, 0.0, 0.0)), IDENTITY, OPTIONS, torch.Generator().manual_seed(1))
    assert torch.equal(far.points, old.points)
    T_other_own = Sim3.from_quaternion(2.0, [0, 0, 0, 1], [0.5, 0.0, 0.0])
    grown = resample(old, sphere(0.3), sphere(0.6, (0.5, 0, 0)), T_other_own, OPTIONS, torch.Generator().manual_seed(1))
    assert len(grown.points) > 210


def test_the_number_of_samples_stays_bounded_and_the_seed_decides_which() -> None:
    few = ResamplingOptions(max_samples=250)
    one, two, other = (
        resample(ball_samples(240), sphere(0.3), sphere(0.3), IDENTITY, few, torch.Generator().manual_seed(seed)).points
        for seed in (5, 5, 6)
    )
    assert torch.equal(one, two)
    assert not torch.equal(one, other)
    assert len(one) == 250
