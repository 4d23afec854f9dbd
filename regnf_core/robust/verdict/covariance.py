"""The pose's 7x7 covariance, from what the residuals tell of the fields' errors.

A field's errors are alike in neighboring points: thousands of samples of a surface that is bent as a whole say no more
than a handful. So the residuals along the surface are taken for one smooth random function (a Gaussian process with a
squared exponential kernel and a nugget), its size and correlation length are weighed by their restricted likelihood
(Patterson & Thompson 1971; so that what the pose itself absorbed is not missed), and the covariance is what such a
function does to the minimum: B K B^T with B = (J^T W' J)^-1 J^T W, averaged over what the likelihood leaves open.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.geometry.exponential_map import skew
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.refine.levenberg_marquardt import (
    OFFSET_PRIOR,
    geman_mcclure_weights,
    kernel_widths,
    with_offset,
)
from regnf_core.robust.residuals import Residuals
from regnf_core.robust.working_frame import WorkingFrame

_LENGTHS = (0.02, 0.03, 0.045, 0.07, 0.1, 0.15, 0.21, 0.3, 0.42, 0.6)
"""Correlation lengths weighed against each other, object diameters."""
_NUGGETS = (0.0003, 0.002, 0.01, 0.05, 0.2, 0.7)
"""Shares of the variance without any correlation."""
_WEIGHED, _PROPAGATED = 160, 900
"""Samples by which the errors' kind is told, and samples through which they act on the pose: smooth errors all but
cancel in some directions, which few samples would not show."""
_LEAST_WEIGHT = 0.3  # samples with less are another thing's, no witnesses of this one's errors
_TINY = 1e-6
_SEED = 0


@dataclass(frozen=True, eq=False)
class _Witnesses:
    """Samples that agree. points (N, 3), object diameters · J (N, 7), with the offset (N, 8) · residuals (N,) ·
    weights, curvatures (N,)."""

    points: Tensor
    J: Tensor
    residuals: Tensor
    weights: Tensor
    curvatures: Tensor

    def first(self, count: int) -> _Witnesses:
        return _Witnesses(*(values[:count] for values in vars(self).values()))


def covariance(r: Residuals, width: Tensor, points: Tensor) -> Tensor:
    """(7, 7) float64 of (omega, dt, log-scale step) for one pose (H = 1), working frames.

    points: (N + M, 3) where the samples lie by that pose, object frame. Positive definite; an object's free axis
    comes out as uncertain as the samples leave it.
    """
    seen = _witnesses(r, float(width), points)
    scales = 1.0 / seen.J.square().mean(0).sqrt().clamp_min(_TINY)  # the unknowns in like units
    seen = replace(seen, J=seen.J * scales)
    variances = _likely_variances(seen.first(_WEIGHED))  # (lengths, nuggets)
    curvature = _curvature(seen)
    if r.offset is not None:
        curvature[7, 7] += OFFSET_PRIOR
    B = torch.linalg.solve(curvature, (seen.J * seen.weights[:, None]).mT)[:7]  # (7, N)
    nuggets = torch.tensor(_NUGGETS, dtype=torch.float64)
    rough = (variances * nuggets).sum()
    cov: Tensor = rough * (B @ B.mT)
    distances = torch.cdist(seen.points, seen.points).float()
    for length, smooth in zip(_LENGTHS, (variances * (1.0 - nuggets)).sum(1), strict=True):
        if smooth > _TINY * variances.sum():
            cov = cov + smooth * (B @ _smooth(distances, length).double() @ B.mT)
    symmetric: Tensor = (cov + cov.mT) / 2.0
    return scales[:7, None] * symmetric * scales[:7]


def _witnesses(r: Residuals, width: float, points: Tensor) -> _Witnesses:
    n, total = r.scene_count, r.values.shape[1]
    share = torch.cat([torch.full((n,), 1.0 / n), torch.full((total - n,), 1.0 / (total - n))]).double()
    # Where the scene lies outside the object, the object lies inside the scene: the same error, the other sign.
    sign = torch.cat([torch.ones(n), -torch.ones(total - n)]).double()
    values = r.values[0].double() * sign
    widths = kernel_widths(r, width)
    widths = widths[0].double() if isinstance(widths, Tensor) else widths
    weights = geman_mcclure_weights(values, widths)
    agreeing = (weights > _LEAST_WEIGHT).nonzero().squeeze(-1)
    if len(agreeing) < 2 * r.jacobian.shape[-1]:  # a pose without support: all that there is
        agreeing = torch.arange(total)
    generator = torch.Generator().manual_seed(_SEED)
    some = agreeing[torch.randperm(len(agreeing), generator=generator)[:_PROPAGATED]]
    squares = (values / widths).square()
    curvatures = weights * share * (1.0 - 3.0 * squares) / (1.0 + squares)
    J = with_offset(r)[0].double() * sign[:, None]
    return _Witnesses(points[some].double(), J[some], values[some], (weights * share)[some], curvatures[some])


def _curvature(seen: _Witnesses) -> Tensor:
    """Second derivative of the robust cost, or half of its Gauss-Newton form where that is not positive."""
    gauss_newton: Tensor = (seen.J * seen.weights[:, None]).mT @ seen.J
    exact: Tensor = (seen.J * seen.curvatures[:, None]).mT @ seen.J
    floor = _TINY * gauss_newton.diagonal().max() * torch.eye(seen.J.shape[1], dtype=torch.float64)
    if float(torch.linalg.eigvalsh(exact)[0]) > float(floor[0, 0]):
        return exact
    return 0.5 * gauss_newton + floor


def _smooth(distances: Tensor, length: Tensor | float) -> Tensor:
    return torch.exp(-0.5 * (distances / length).square())


def _likely_variances(seen: _Witnesses) -> Tensor:
    """(lengths, nuggets) variances of the errors, each times how likely its kind is by the restricted likelihood."""
    lengths = torch.tensor(_LENGTHS, dtype=torch.float64)[:, None, None]
    nuggets = torch.tensor(_NUGGETS, dtype=torch.float64)[:, None, None]
    alone = torch.eye(len(seen.points), dtype=torch.float64)
    smooth = _smooth(torch.cdist(seen.points, seen.points), lengths)[:, None]
    K = (1.0 - nuggets) * smooth + (nuggets + _TINY) * alone  # (lengths, nuggets, N, N)
    factor = torch.linalg.cholesky(K)
    both = torch.cat([seen.J, seen.residuals[:, None]], 1).expand(*K.shape[:2], -1, -1)
    white = torch.linalg.solve_triangular(factor, both, upper=False)
    X, y = white[..., :-1], white[..., -1:]
    A = X.mT @ X + _TINY * torch.eye(X.shape[-1], dtype=torch.float64)
    b = X.mT @ y
    squares = (y.mT @ y - b.mT @ torch.linalg.solve(A, b)).squeeze(-1).squeeze(-1)
    freedom = max(len(seen.points) - X.shape[-1], 1)
    variance: Tensor = (squares / freedom).clamp_min(1e-18)
    determinant = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) + torch.logdet(A)
    likelihood: Tensor = -0.5 * (freedom * variance.log() + determinant)
    likely = torch.softmax(likelihood.flatten(), 0).reshape(variance.shape)
    return variance * likely


def in_object_units(cov: Tensor, T_work: Sim3, scene: WorkingFrame, obj: WorkingFrame) -> Tensor:
    """The covariance (7, 7) of the same perturbation (omega, dt, log-scale step) in the fields' own frames.

    A perturbation moves y to t + dt + e^sigma exp(omega)(y - t), t the image of the scene frame's origin: another
    frame, another t.
    """
    origin = ((torch.zeros(3, dtype=torch.float64) - scene.center) / scene.length)[None]
    arm = T_work.apply(origin)[0] - T_work.translation
    L = torch.eye(7, dtype=torch.float64)
    L[3:6, 3:6] *= obj.length
    L[3:6, 0:3] = -obj.length * skew(arm)
    L[3:6, 6] = obj.length * arm
    return L @ cov @ L.T
