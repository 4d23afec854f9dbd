"""How far a pose lies from the truth, measured by the covariance that came with it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.stats import chi2
from torch import Tensor

from benchmarks.symmetric_errors import Symmetries, mssd
from regnf_core import Sim3

FREEDOM = 7
LIMIT = float(chi2.ppf(0.95, FREEDOM))
"""Mahalanobis distance squared on the surface of the 95 % ellipsoid."""


def pose_error(estimate: Sim3, truth: Sim3) -> Tensor:
    """(7,) float64 (omega, dt, d log s): the left perturbation that carries the estimate to the truth.

    s e^(d log s), exp(omega) R, t + dt, as RegistrationResult.covariance has it; radians and object units.
    """
    turn = Sim3(torch.ones(()).double(), truth.rotation @ estimate.rotation.mT, torch.zeros(3).double())
    omega = turn.log()[:3]
    shift = truth.translation - estimate.translation
    return torch.cat([omega, shift, (truth.scale / estimate.scale).log().reshape(1)])


def mahalanobis_squared(error: Tensor, covariance: Tensor) -> float:
    """error^T covariance^-1 error; infinite where the covariance is no covariance (not finite, not positive)."""
    if not bool(torch.isfinite(covariance).all()):
        return float("inf")
    # Radians, lengths and a logarithm may differ in size by orders of magnitude: unit diagonal first.
    spread = covariance.diagonal().clamp_min(0.0).sqrt()
    if not bool((spread > 0).all()):
        return float("inf")
    factor, failed = torch.linalg.cholesky_ex(covariance / spread[:, None] / spread)
    if int(failed) != 0:
        return float("inf")
    whitened = torch.linalg.solve_triangular(factor, (error / spread)[:, None], upper=False)
    return float(whitened.square().sum())


def nearest_truth(estimate: Sim3, truth: Sim3, points: Tensor, symmetries: Symmetries) -> Sim3:
    """The true pose nearest to the estimate, of those that the symmetries give; object points (N, 3)."""
    S = symmetries.transforms()
    every = [Sim3(S.scale[k], S.rotation[k], S.translation[k]) @ truth for k in range(S.scale.shape[0])]
    return min(every, key=lambda one: mssd(estimate, one, points))


@dataclass(frozen=True)
class Calibration:
    """Errors against their covariances: share inside the 95 % ellipsoid, median and 95th percentile of d^2 / 7.

    Well calibrated: 0.95, 0.907 and 2.01. Larger percentiles mean that too much was promised, smaller too little.
    """

    count: int
    inside: float
    median: float
    high: float


def calibration(squares: list[float]) -> Calibration:
    """Of Mahalanobis distances squared, any of which may be infinite."""
    if not squares:
        return Calibration(0, float("nan"), float("nan"), float("nan"))
    values = torch.tensor(squares, dtype=torch.float64).sort().values
    inside = float((values <= LIMIT).double().mean())
    middle = float(values[len(values) // 2])
    high = float(values[min(int(0.95 * len(values)), len(values) - 1)])
    return Calibration(len(values), inside, middle / FREEDOM, high / FREEDOM)
