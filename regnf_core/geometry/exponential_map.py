"""The exponential and logarithm of Sim(3): plain batched formulas on tensors.

The seven numbers of a pose have one order everywhere: rotation vector omega (3, radians), translation part (3), log
scale sigma (1). The covariance of a result has this order too.

The tangent (omega, rho, sigma) stands for the 4x4 matrix [[skew(omega) + sigma I, rho], [0, 0]]. Its exponential has
scale exp(sigma), rotation exp(skew(omega)) and translation W rho with

    W = integral over u in [0, 1] of exp(u (skew(omega) + sigma I)) = C I + A skew(omega) + B skew(omega)^2.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.rotations import rotation_rows

# Quaternions and rotation matrices: plain batched formulas on tensors. Quaternions are ordered (x, y, z, w).


def matrix_from_quaternion(q: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4), ordered (x, y, z, w)."""
    x, y, z, w = q.unbind(-1)
    rows = rotation_rows(x, y, z, w)
    return torch.stack([entry for row in rows for entry in row], dim=-1).reshape(*q.shape[:-1], 3, 3)


def _entries() -> Tensor:
    """(16, 9): the entries of R - 1 as sums of products of the quaternion's numbers. All terms are of second degree, so
    that they follow from the values at sums of two unit vectors."""
    unit = np.eye(4)

    def at(q: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array(rotation_rows(*q)).reshape(9) - np.eye(3).reshape(9)

    return torch.from_numpy(np.array([(at(a + b) - at(a) - at(b)) / 2.0 for a in unit for b in unit]))


_ENTRIES = _entries()


def quaternion_from_matrix(R: Tensor) -> Tensor:
    """Unit quaternions (..., 4), ordered (x, y, z, w), w >= 0, of rotation matrices (..., 3, 3).

    The four rows below are all multiples of the quaternion; the longest is the well-conditioned one.
    """
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)
    d0, d1, d2 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    s01, s02, s12 = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    a0, a1, a2 = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    rows = torch.stack(
        [
            torch.stack([1 + d0 - d1 - d2, s01, s02, a0], -1),
            torch.stack([s01, 1 - d0 + d1 - d2, s12, a1], -1),
            torch.stack([s02, s12, 1 - d0 - d1 + d2, a2], -1),
            torch.stack([a0, a1, a2, 1 + trace], -1),
        ],
        dim=-2,
    )  # (..., 4, 4)
    longest = rows.norm(dim=-1).argmax(-1)
    q = rows.gather(-2, longest[..., None, None].expand(*longest.shape, 1, 4)).squeeze(-2)
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., 3:] < 0, -q, q)


_SMALL_ANGLE = 1e-4  # below it, terms of third order in the angle are under 1e-12
_SMALL_EXPONENT = 0.5  # below it the power series needs fewer than 20 terms for full precision
_SERIES_TERMS = 20


def skew(vectors: Tensor) -> Tensor:
    """(..., 3, 3) with skew(v) @ w = v x w, for vectors (..., 3)."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*vectors.shape[:-1], 3, 3)


def split_tangent(step: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation vector (..., 3), translation part (..., 3) and log scale (...) of (..., 7)."""
    return step[..., :3], step[..., 3:6], step[..., 6]


def exp_parts(tangent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Scale (...), rotation (..., 3, 3) and translation (..., 3) of the tangents (omega, rho, sigma), (..., 7)."""
    omega, rho, sigma = split_tangent(tangent)
    translation = (_w_matrix(omega, sigma) @ rho.unsqueeze(-1)).squeeze(-1)
    return sigma.exp(), rotation_exp(omega), translation


def log_parts(scale: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """The tangent (omega, rho, sigma), (..., 7), of a similarity; inverse of :func:`exp_parts` for angles up to pi."""
    omega = rotation_log(rotation)
    sigma = scale.log()
    rho = torch.linalg.solve(_w_matrix(omega, sigma), translation.unsqueeze(-1)).squeeze(-1)
    return torch.cat([omega, rho, sigma.unsqueeze(-1)], dim=-1)


def rotation_exp(omega: Tensor) -> Tensor:
    """Rotation vectors (..., 3) to matrices, through the quaternion: sinc has no trouble at zero."""
    angle = omega.norm(dim=-1, keepdim=True)
    vector = 0.5 * torch.sinc(angle / (2 * torch.pi)) * omega
    q = torch.cat([vector, (angle / 2).cos()], dim=-1)
    # as of matrix_from_quaternion but for rounding, in five operations in place of forty
    products = (q[..., :, None] * q[..., None, :]).flatten(-2)
    turned: Tensor = (products @ _ENTRIES.to(q)).reshape(*q.shape[:-1], 3, 3)
    return turned + torch.eye(3, dtype=q.dtype, device=q.device)


def rotation_log(R: Tensor) -> Tensor:
    """Rotation matrices to vectors (..., 3) of length at most pi; accurate near 0 and near pi alike."""
    q = quaternion_from_matrix(R)
    vector, w = q[..., :3], q[..., 3:]
    length = vector.norm(dim=-1, keepdim=True)
    ratio = torch.where(length > 1e-12, 2 * torch.atan2(length, w) / length.clamp_min(1e-300), 2.0 / w.clamp_min(0.5))
    return ratio * vector


def _w_matrix(omega: Tensor, sigma: Tensor) -> Tensor:
    """W (..., 3, 3), which carries rho to the translation.

    With z = sigma + i theta and phi(z) = (e^z - 1) / z, the integrals of e^(sigma u) cos(theta u) and
    e^(sigma u) sin(theta u) are the real and imaginary part of phi(z). Dividing by theta and theta^2 loses digits
    for small angles, but A and B multiply matrices that are as small, so W keeps full precision.
    """
    theta = omega.norm(dim=-1)
    small = theta < _SMALL_ANGLE
    safe = torch.where(small, torch.ones_like(theta), theta)
    cosine, sine = _phi(sigma, safe)
    C = _moment(0, sigma)
    A = torch.where(small, _moment(1, sigma), sine / safe)
    B = torch.where(small, _moment(2, sigma) / 2, (C - cosine) / safe**2)
    K = skew(omega)
    eye = torch.eye(3, dtype=omega.dtype, device=omega.device)
    return C[..., None, None] * eye + A[..., None, None] * K + B[..., None, None] * (K @ K)


def _phi(sigma: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Integrals over [0, 1] of e^(sigma u) cos(theta u) and e^(sigma u) sin(theta u)."""
    growth = sigma.exp()
    square = sigma**2 + theta**2
    cosine = (growth * (sigma * theta.cos() + theta * theta.sin()) - sigma) / square
    sine = (growth * (sigma * theta.sin() - theta * theta.cos()) + theta) / square
    tiny = square < _SMALL_EXPONENT**2
    real, imaginary = _phi_series(sigma, theta)
    return torch.where(tiny, real, cosine), torch.where(tiny, imaginary, sine)


def _phi_series(sigma: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Real and imaginary part of sum over n of z^n / (n + 1)!, z = sigma + i theta, by Horner's scheme."""
    real, imaginary = torch.ones_like(sigma), torch.zeros_like(sigma)
    for n in range(_SERIES_TERMS, 1, -1):
        real, imaginary = 1 + (sigma * real - theta * imaginary) / n, (sigma * imaginary + theta * real) / n
    return real, imaginary


def _moment(k: int, sigma: Tensor) -> Tensor:
    """Integral over [0, 1] of u^k e^(sigma u)."""
    series = torch.zeros_like(sigma)
    power = torch.ones_like(sigma)
    for n in range(_SERIES_TERMS):
        series = series + power / (n + k + 1)
        power = power * sigma / (n + 1)
    small = sigma.abs() < _SMALL_EXPONENT
    safe = torch.where(small, torch.ones_like(sigma), sigma)
    value = torch.expm1(safe) / safe
    for j in range(1, k + 1):
        value = (safe.exp() - j * value) / safe
    return torch.where(small, series, value)
