"""The Geman-McClure kernel (Geman & McClure 1987), written once: loss, weight and curvature.

With q = (r / c)^2 for a residual r and a kernel width c, in the same unit:

    loss       q / (1 + q)                 0 at r = 0, 1/2 at one width, 1 far out
    agreement  1 / (1 + q)                 1 - loss
    weight     1 / (1 + q)^2               of r in iteratively reweighted least squares
    curvature  weight (1 - 3 q) / (1 + q)  second derivative of the loss, times c^2 / 2

All functions are elementwise; residuals and widths broadcast.
"""

from __future__ import annotations

from torch import Tensor


def geman_mcclure_loss(r: Tensor, width: Tensor | float) -> Tensor:
    """The loss, 0..1."""
    squares = r.square()
    return squares / (squares + width**2)


def geman_mcclure_agreement(r: Tensor, width: Tensor | float) -> Tensor:
    """1 - loss, 0..1."""
    return width**2 / (r.square() + width**2)


def geman_mcclure_weight(r: Tensor, width: Tensor | float) -> Tensor:
    """The weight of a residual in least squares, 0..1."""
    return geman_mcclure_agreement(r, width).square()


def geman_mcclure_curvature(r: Tensor, width: Tensor | float, weight: Tensor) -> Tensor:
    """The curvature, where ``weight`` is the kernel's weight, times any weight of the sample itself."""
    squares = (r / width).square()
    return weight * (1.0 - 3.0 * squares) / (1.0 + squares)
