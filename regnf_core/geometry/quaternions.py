"""Quaternions and rotation matrices: plain batched formulas on tensors. Quaternions are ordered (x, y, z, w)."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.rotations import rotation_rows


def matrix_from_quaternion(q: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4), ordered (x, y, z, w)."""
    x, y, z, w = q.unbind(-1)
    rows = rotation_rows(x, y, z, w)
    return torch.stack([entry for row in rows for entry in row], dim=-1).reshape(*q.shape[:-1], 3, 3)


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
