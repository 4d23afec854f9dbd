"""The covariance's two factors (regnf_core/robust/constants.py), fitted to the errors of right poses.

The covariance of a pose is one part that the residuals tell and one that follows from the surfaces' offset, each times
a factor. ``register`` keeps the error of each right pose in coordinates in which both parts are diagonal. So other
factors can be tried without registering again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import minimize
from scipy.special import gammaln
from torch import Tensor

from benchmarks.robust.ellipsoid import FREEDOM, LIMIT
from regnf_core import Sim3
from regnf_core.robust.constants import COVARIANCE
from regnf_core.robust.verdict.covariance import of_offset

Run = dict[str, Any]
Array = NDArray[np.float64]
_INSIDE = 0.95
_LEAST_FREEDOM = 1.0
"""Degrees of freedom: below, a Student distribution has no mean."""


@dataclass(frozen=True)
class Factors:
    """residuals: of the covariance that the residuals tell · offset: of the offset, as an error of the pose · freedom:
    of the Student distribution that the errors have with that covariance, before it was scaled to hold 95 %."""

    residuals: float
    offset: float
    freedom: float


def diagonal_parts(error: Tensor, covariance: Tensor, points: Tensor, T: Sim3, offset: float) -> Run:
    """A pose's error where both parts of its covariance are diagonal.

    error: (7,) as :func:`benchmarks.robust.ellipsoid.pose_error` gives it · covariance: (7, 7) of the result · points:
    (N, 3) of the object's surface, its frame · T: the pose, scene to object · offset: of the surfaces, object units.
    whitened_error: (7,), variance 1 each if the covariance holds · offset_share: (7,) of that variance is from the
    offset. Both are None where the covariance is not positive definite.
    """
    spread = covariance.diagonal().clamp_min(0.0).sqrt()  # radians, lengths, a logarithm: similar sizes first
    both = (spread[:, None] * spread).clamp_min(torch.finfo(torch.float64).tiny)
    try:
        shares, axes = eigh((of_offset(points, T, offset) / both).numpy(), (covariance / both).numpy())
    except (np.linalg.LinAlgError, ValueError):
        return {"whitened_error": None, "offset_share": None}
    whitened = axes.T @ (error / spread).numpy()
    return {"whitened_error": whitened.tolist(), "offset_share": np.clip(shares, 0.0, 1.0).tolist()}


def fitted(runs: Sequence[Run]) -> Factors:
    """The factors under which the errors are likeliest, then scaled so that 95 % of them lie in their ellipsoids.

    The errors have heavy tails: a Student distribution with unknown degrees of freedom (Lange, Little & Taylor 1989).
    """
    errors, shares = _arrays(runs)

    def cost(unknowns: Array) -> float:
        freedom = _LEAST_FREEDOM + math.exp(unknowns[2])
        return _negative_log_likelihood(errors, _variances(shares, *np.exp(unknowns[:2])), freedom)

    found = minimize(cost, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-7, "maxiter": 4000})
    residuals, offset = np.exp(found.x[:2])
    squares = (errors**2 / _variances(shares, residuals, offset)).sum(1)
    wider = float(np.quantile(squares, _INSIDE)) / LIMIT
    return Factors(
        COVARIANCE.residuals_factor * float(residuals) * wider,
        COVARIANCE.offset_factor * math.sqrt(float(offset) * wider),
        _LEAST_FREEDOM + math.exp(found.x[2]),
    )


def squares_with(runs: Sequence[Run], factors: Factors) -> Array:
    """(N,) Mahalanobis distances squared of the true poses, had the covariances these factors."""
    errors, shares = _arrays(runs)
    residuals = factors.residuals / COVARIANCE.residuals_factor
    offset = (factors.offset / COVARIANCE.offset_factor) ** 2
    return np.asarray((errors**2 / _variances(shares, residuals, offset)).sum(1))


def markdown(runs: Sequence[Run]) -> str:
    """The factors fitted to each part and to all, and what comes of them on each part. Runs with a known scale are left
    out: it changes both parts of the covariance."""
    told = [run for run in runs if run.get("whitened_error") is not None and run["known_scale"] is None]
    parts = {part: [run for run in told if run["part"] == part] for part in sorted({run["part"] for run in told})}
    groups = parts if len(parts) < 2 else {**parts, "all": told}
    head = ["fitted to", "right poses", "residuals_factor", "offset_factor", "degrees of freedom"]
    head += [f"{part}: in the 95 % ellipsoid; median of d²/7" for part in parts]
    rows = []
    for name, some in groups.items():
        factors = fitted(some)
        numbers = [f"{value:.2f}" for value in (factors.residuals, factors.offset, factors.freedom)]
        rows.append([name, str(len(some)), *numbers, *(_holds(squares_with(part, factors)) for part in parts.values())])
    now = Factors(COVARIANCE.residuals_factor, COVARIANCE.offset_factor, math.nan)
    numbers = [f"{now.residuals:g}", f"{now.offset:g}", ""]
    rows.append(["the engine's", "", *numbers, *(_holds(squares_with(part, now)) for part in parts.values())])
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, ["---"] * len(head), *rows]) + "\n"


def _holds(squares: Array) -> str:
    inside = int((squares <= LIMIT).sum())
    return f"{inside} of {len(squares)} ({100 * inside / len(squares):.0f} %); {np.median(squares) / FREEDOM:.2f}"


def _arrays(runs: Sequence[Run]) -> tuple[Array, Array]:
    """(N, 7) errors and shares."""
    return np.array([run["whitened_error"] for run in runs]), np.array([run["offset_share"] for run in runs])


def _variances(shares: Array, residuals: float, offset: float) -> Array:
    """(N, 7) of the whitened errors, with each part this many times as large as in the engine."""
    smallest = float(np.finfo(np.float64).eps)
    return np.asarray(np.maximum(residuals * (1.0 - shares) + offset * shares, smallest))


def _negative_log_likelihood(errors: Array, variances: Array, freedom: float) -> float:
    """Mean over the errors (N, 7), of a multivariate Student distribution."""
    whole = freedom + FREEDOM
    constant = gammaln(whole / 2.0) - gammaln(freedom / 2.0) - 0.5 * FREEDOM * math.log(math.pi * freedom)
    squares = (errors**2 / variances).sum(1)
    likely = constant - 0.5 * np.log(variances).sum(1) - 0.5 * whole * np.log1p(squares / freedom)
    return -float(likely.mean())
