"""Barron's kernel: hand-computed values, limits, the normalizer by an independent quadrature, what learning does."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.special import k1

from regnf_core.paper.optimization import SHAPE_RANGE, AdaptiveKernel, log_partition, robust_kernel

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


def test_partition_where_it_is_known() -> None:
    # alpha = 1: integral of exp(1 - sqrt(x^2 + 1)) = 2 e K1(1); alpha -> 0: integral of 1 / (x^2 / 2 + 1) = pi sqrt 2.
    assert float(log_partition(torch.tensor(1.0, dtype=torch.float64))) == pytest.approx(math.log(2 * math.e * k1(1.0)))
    assert float(log_partition(torch.tensor(1e-7, dtype=torch.float64))) == pytest.approx(
        math.log(math.pi * math.sqrt(2)), abs=1e-5
    )


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


def test_starts_at_scale_one_and_mid_shape() -> None:
    kernel = AdaptiveKernel()
    assert float(kernel.scale.detach()) == pytest.approx(1.0)
    assert float(kernel.shape.detach()) == pytest.approx(sum(SHAPE_RANGE) / 2)


def test_latents_cannot_leave_the_ranges() -> None:
    kernel = AdaptiveKernel()
    for latent in (-1e3, 1e3):
        with torch.no_grad():
            kernel.latents.fill_(latent)
        assert SHAPE_RANGE[0] <= float(kernel.shape.detach()) <= SHAPE_RANGE[1]
        assert float(kernel.scale.detach()) > 0


def _learn(residuals: torch.Tensor) -> AdaptiveKernel:
    kernel = AdaptiveKernel()
    adam = torch.optim.Adam([kernel.latents], lr=0.05)
    for _ in range(400):
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
