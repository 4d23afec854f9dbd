"""The pose's 7x7 covariance, from what the residuals tell of the fields' errors.

A field's errors are similar at neighboring points that face the same way: thousands of samples of a surface that is
bent as a whole tell no more than a few, and two faces of a box, seen by other images, are off on their own, although
they meet at an edge. So the residuals along the surface are modeled as one random function of place and normal, a
Gaussian process with a squared exponential kernel and a nugget. Its variance and correlation length are weighted by
their restricted likelihood (Patterson & Thompson 1971), which accounts for the part that the pose itself absorbed. The
covariance is the effect of such a function on the minimum: B K B^T with B = (J^T W' J)^-1 J^T W, averaged by the
likelihood.

What both fields have in common, or what the pose absorbed altogether, is not in the residuals. Its size follows from
the offset between the surfaces: fields that are too thick are not equally thick everywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.geometry.bundle import Bundle
from regnf_core.geometry.exponential_map import skew
from regnf_core.geometry.sim3 import Sim3
from regnf_core.native import steps as compiled
from regnf_core.robust.constants import COVARIANCE
from regnf_core.robust.refine.loss import facing, kernel_widths, observed_weight, offset_prior, sample_weights
from regnf_core.robust.residuals import Residuals, geman_mcclure_curvature, geman_mcclure_weight
from regnf_core.robust.working_frame import WorkingFrame, fixed_generator

_TINY = COVARIANCE.regularization


@dataclass(frozen=True, eq=False)
class _Inliers(Bundle):
    """Samples that agree with the pose. points (N, 3), object diameters · normals (N, 3) · J (N, 7), with the offset
    (N, 8) · residuals (N,) · weights, curvatures (N,)."""

    points: Tensor
    normals: Tensor
    J: Tensor
    residuals: Tensor
    weights: Tensor
    curvatures: Tensor


def covariance(r: Residuals, width: Tensor, points: Tensor) -> Tensor:
    """(7, 7) float64 of (omega, dt, log-scale step) for one pose (H = 1), working frames: from the residuals alone.

    width: of the kernel · points: (N + M, 3) where the samples lie under that pose, object frame. Positive definite; a
    rotation about an object's axis of continuous symmetry is as uncertain as the samples leave it.
    """
    inliers = _inliers(r, width, points)
    scales = 1.0 / inliers.J.square().mean(0).sqrt().clamp_min(_TINY)  # all unknowns in similar units
    inliers = replace(inliers, J=inliers.J * scales)
    variances = _likely_variances(inliers[: COVARIANCE.likelihood_samples])  # (lengths, nuggets)
    curvature = _curvature(inliers)
    if r.offset is not None:
        curvature[7, 7] += offset_prior(r.unobserved is not None)
    B = torch.linalg.solve(curvature, (inliers.J * inliers.weights[:, None]).mT)[:7]  # (7, N)
    nuggets = torch.tensor(COVARIANCE.nuggets, dtype=torch.float64)
    rough = (variances * nuggets).sum()
    cov: Tensor = rough * (B @ B.mT)
    weights = (variances * (1.0 - nuggets)).sum(1)
    cov = cov + B @ _summed(inliers, weights * (weights > _TINY * variances.sum())).double() @ B.mT
    symmetric: Tensor = (cov + cov.mT) / 2.0
    return scales[:7, None] * symmetric * scales[:7]


def with_common_errors(cov: Tensor, points: Tensor, T: Sim3, offset: float) -> Tensor:
    """The covariance (7, 7) that is given, from the one that the residuals tell; working frames. Others: as
    :func:`of_offset`."""
    return COVARIANCE.residuals_factor * cov + of_offset(points, T, offset)


def of_offset(points: Tensor, T: Sim3, offset: float) -> Tensor:
    """The part (7, 7) of the covariance that follows from the offset between the surfaces.

    points: (N, 3) of the object's surface · T: the pose · offset: in the points' units. It is an error of the pose
    alone, in proportion to the offset, in which every direction moves the points by the same root mean square.
    """
    arms = points.double() - T.translation
    moves = torch.cat([-skew(arms), torch.eye(3).double().expand(len(arms), 3, 3), arms[..., None]], -1)  # (N, 3, 7)
    metric = (moves.mT @ moves).mean(0)
    metric = metric + _TINY * metric.diagonal().mean() * torch.eye(7).double()
    part: Tensor = (COVARIANCE.offset_factor * offset) ** 2 * torch.linalg.inv(metric)
    return part


def _inliers(r: Residuals, width: Tensor, points: Tensor) -> _Inliers:
    """The weights are those of the refinement: they say how errors of the samples move its minimum."""
    n, total = r.scene_count, r.values.shape[1]
    # Where the scene lies outside the object, the object lies inside the scene: the same error, the other sign.
    sign = torch.cat([torch.ones(n), -torch.ones(total - n)]).double()
    values = r.values[0].double() * sign
    widths = kernel_widths(r, width)
    widths = widths[0].double() if isinstance(widths, Tensor) else widths
    weights = r.weighted(sample_weights(r, width, weight=observed_weight(r)))[0].double()
    agrees = (geman_mcclure_weight(values, widths) > COVARIANCE.min_weight) & (facing(r)[0] > COVARIANCE.min_weight)
    agreeing = (agrees & (weights > 0.0)).nonzero().squeeze(-1)
    if len(agreeing) < 2 * r.jacobian.shape[-1]:  # hardly any sample agrees: all of them count
        agreeing = torch.arange(total)
    few = agreeing[torch.randperm(len(agreeing), generator=fixed_generator())[: COVARIANCE.propagated_samples]]
    curvatures = geman_mcclure_curvature(values, widths, weights)
    J = r.jacobian_with_offset()[0].double() * sign[:, None]
    normals = torch.nn.functional.normalize(J[:, 3:6], dim=1)
    return _Inliers(points[few].double(), normals[few], J[few], values[few], weights[few], curvatures[few])


def _curvature(inliers: _Inliers) -> Tensor:
    """Second derivative of the robust cost, or half of its Gauss-Newton form where that is not positive."""
    gauss_newton: Tensor = (inliers.J * inliers.weights[:, None]).mT @ inliers.J
    exact: Tensor = (inliers.J * inliers.curvatures[:, None]).mT @ inliers.J
    floor = _TINY * gauss_newton.diagonal().max() * torch.eye(inliers.J.shape[1], dtype=torch.float64)
    if float(torch.linalg.eigvalsh(exact)[0]) > float(floor[0, 0]):
        return exact
    return 0.5 * gauss_newton + floor


def _squares(inliers: _Inliers) -> tuple[Tensor, Tensor]:
    """(N, N) squared distances of the places, and of the normals in units in which they are alike."""
    places = torch.cdist(inliers.points, inliers.points).square()
    return places, (torch.cdist(inliers.normals, inliers.normals) / COVARIANCE.normals_length).square()


def _smooth(squares: Tensor, turned: Tensor, length: Tensor | float) -> Tensor:
    """The kernel at squared distances of places and of normals."""
    return (-0.5 * (squares / length**2 + turned)).exp_()


def _summed(inliers: _Inliers, weights: Tensor) -> Tensor:
    """(N, N) float32: the sum of the kernels of all lengths, times weights (lengths,). Their entries take most of the
    time."""
    lengths = torch.tensor(COVARIANCE.lengths, dtype=torch.float64)
    lengths, weights = lengths[weights > 0.0], weights[weights > 0.0]
    found = compiled.kernel_sums(inliers.points, inliers.normals / COVARIANCE.normals_length, lengths, weights)
    if found is not None:
        return found
    squares, turned = (part.float() for part in _squares(inliers))
    total = torch.zeros_like(squares)
    for length, weight in zip(lengths.tolist(), weights.tolist(), strict=True):
        total += weight * _smooth(squares, turned, length)
    return total


def _likely_variances(inliers: _Inliers) -> Tensor:
    """(lengths, nuggets) variances of the errors, each times the restricted likelihood of length and nugget."""
    # The pose has absorbed part of the errors, up to one number for each unknown: what is left is judged by the
    # restricted likelihood, that of the residuals' part which no pose changes.
    lengths = torch.tensor(COVARIANCE.lengths, dtype=torch.float64)[:, None, None]
    nuggets = torch.tensor(COVARIANCE.nuggets, dtype=torch.float64)[:, None, None]
    alone = torch.eye(len(inliers.points), dtype=torch.float64)
    smooth = _smooth(*_squares(inliers), lengths)[:, None]
    K = (1.0 - nuggets) * smooth + (nuggets + _TINY) * alone  # (lengths, nuggets, N, N)
    factor = torch.linalg.cholesky(K)
    both = torch.cat([inliers.J, inliers.residuals[:, None]], 1).expand(*K.shape[:2], -1, -1)
    white = torch.linalg.solve_triangular(factor, both, upper=False)
    X, y = white[..., :-1], white[..., -1:]
    A = X.mT @ X + _TINY * torch.eye(X.shape[-1], dtype=torch.float64)
    b = X.mT @ y
    squares = (y.mT @ y - b.mT @ torch.linalg.solve(A, b)).squeeze(-1).squeeze(-1)
    freedom = max(len(inliers.points) - X.shape[-1], 1)
    variance: Tensor = (squares / freedom).clamp_min(COVARIANCE.min_variance)
    determinant = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) + torch.logdet(A)
    likelihood: Tensor = -0.5 * (freedom * variance.log() + determinant)
    likely = torch.softmax(likelihood.flatten(), 0).reshape(variance.shape)
    return variance * likely


def with_known_scale(cov: Tensor, log_width: float) -> Tensor:
    """The covariance (7, 7) where the log scale is known to lie in an interval of this width; infinite: it is not.

    What is known counts as a measurement with the interval's variance: exact for a fixed scale, and a wide interval
    changes little.
    """
    if math.isinf(log_width):
        return cov
    # of an even distribution: its width squared over 12; a Kalman update by that measurement of the last unknown
    column, variance = cov[:, 6:], (log_width / 2.0) ** 2 / 3.0 + _TINY**2
    known: Tensor = cov - column @ column.mT / (column[6] + variance)
    return known


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
