"""Euler angles as the paper learns and reports them: roll, pitch, yaw about the fixed axes x, y, z, in that order.

They are singular at pitch +-pi/2 (gimbal lock); the preset ``paper`` uses them because the published method does.
"""

from __future__ import annotations

import torch
from torch import Tensor


def rotation_from_euler(angles: Tensor) -> Tensor:
    """R = Rz(yaw) Ry(pitch) Rx(roll), (..., 3, 3), of angles (..., 3) = (roll, pitch, yaw), radians. Differentiable."""
    (cr, cp, cy), (sr, sp, sy) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    rows = [
        cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
        sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
        -sp, cp * sr, cp * cr,
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*angles.shape[:-1], 3, 3)


def euler_from_rotation(R: Tensor) -> Tensor:
    """(roll, pitch, yaw) (..., 3) in radians, pitch within +-pi/2. Where they are singular, roll is zero."""
    cosine = torch.hypot(R[..., 2, 1], R[..., 2, 2])
    pitch = torch.atan2(-R[..., 2, 0], cosine)
    singular = cosine < 1e-9
    roll = torch.where(singular, torch.zeros_like(pitch), torch.atan2(R[..., 2, 1], R[..., 2, 2]))
    yaw = torch.where(singular, torch.atan2(-R[..., 0, 1], R[..., 1, 1]), torch.atan2(R[..., 1, 0], R[..., 0, 0]))
    return torch.stack([roll, pitch, yaw], dim=-1)
