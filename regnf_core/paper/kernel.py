"""Barron's general and adaptive robust kernel ("A General and Adaptive Robust Loss Function", CVPR 2019).

    rho(r, alpha, p) = |alpha - 2| / alpha * (((r / p)^2 / |alpha - 2| + 1)^(alpha / 2) - 1)

alpha is the shape (1: Charbonnier, towards 0: Cauchy), p the scale. Minimized over p on its own, rho has no minimum: it
falls towards zero as p grows. Learning p therefore needs the adaptive form, the negative log likelihood of the density
whose exponent is -rho, and its normalizer p Z(alpha):

    kappa(r; alpha, p) = rho(r, alpha, p) + log p + log Z(alpha),   Z(alpha) = integral of exp(-rho(x, alpha, 1)) dx.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

SHAPE_RANGE = (0.001, 1.0)  # within the paper's (0, 1]; the lower end keeps alpha / 2 away from zero
SCALE_FLOOR = 1e-5  # Barron's; keeps r / p finite
_NODES = 601
_REACH = 60.0  # x = sinh(u), |u| up to this: exp(60) is far beyond where the heaviest tail has faded


def robust_kernel(residual: Tensor, shape: Tensor | float, scale: Tensor | float) -> Tensor:
    """rho(r, alpha, p), elementwise, for alpha within (0, 2). Zero at r = 0; differentiable in all three."""
    a = torch.as_tensor(shape, dtype=residual.dtype, device=residual.device)
    gap = 2.0 - a
    return gap / a * torch.expm1(a / 2 * torch.log1p((residual / scale).square() / gap))


def log_partition(shape: Tensor) -> Tensor:
    """log Z(alpha), (), by the trapezoidal rule after x = sinh(u). Differentiable in alpha.

    The rule converges exponentially for such integrands; no table to look up, none to ship.
    """
    u = torch.linspace(0.0, _REACH, _NODES, dtype=torch.float64, device=shape.device)
    log_weight = u + torch.log1p(torch.exp(-2 * u)) - math.log(2.0)  # log cosh(u) = log dx/du
    log_value = log_weight - robust_kernel(u.sinh(), shape.double(), 1.0)
    ends = torch.zeros_like(u)
    ends[0] = ends[-1] = math.log(0.5)
    step = _REACH / (_NODES - 1)
    return (torch.logsumexp(log_value + ends, 0) + math.log(2.0 * step)).to(shape.dtype)


class AdaptiveKernel:
    """The kernel with learned shape and scale.

    Both are functions of unconstrained latents, as Barron proposes: the shape a sigmoid stretched over SHAPE_RANGE,
    the scale a softplus above SCALE_FLOOR. ``latents`` (2,) float64 is the optimizer's parameter. The scale starts
    at 1, the shape in the middle of its range.
    """

    def __init__(self, scale: float = 1.0) -> None:
        raw_scale = math.log(math.expm1(scale - SCALE_FLOOR))  # inverse softplus
        self.latents = torch.tensor([0.0, raw_scale], dtype=torch.float64, requires_grad=True)

    @property
    def shape(self) -> Tensor:
        """alpha, ()."""
        low, high = SHAPE_RANGE
        return low + (high - low) * torch.sigmoid(self.latents[0])

    @property
    def scale(self) -> Tensor:
        """p, ()."""
        return torch.nn.functional.softplus(self.latents[1]) + SCALE_FLOOR

    def negative_log_likelihood(self, residuals: tuple[Tensor, ...]) -> Tensor:
        """Sum over the sets of the mean of kappa over each set (N_i,); ()."""
        shape, scale = self.shape, self.scale
        normalizer = scale.log() + log_partition(shape)
        means = [robust_kernel(r.double(), shape, scale).mean() for r in residuals]
        return torch.stack(means).sum() + len(means) * normalizer
