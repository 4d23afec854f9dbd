"""The uncertainty of a pose in degrees, scene units and percent, from its covariance."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from regnf_core.geometry.exponential_map import skew
from regnf_core.geometry.sim3 import Sim3

COVARIANCE_ORDERING = ("omega_x", "omega_y", "omega_z", "t_x", "t_y", "t_z", "log_s")
"""What the rows and columns of a covariance belong to: see :attr:`regnf_core.result.RegistrationResult.covariance`."""


def center_covariance(covariance: Tensor, T_object_scene: Sim3, center: Tensor) -> Tensor:
    """(3, 3) float64, scene frame and units: of the place of an object's point ``center`` (3,), object frame.

    The point lies at p = R^T (c - t) / s. To first order a perturbation moves it by R^T ((c - t) x omega - dt -
    (c - t) log_s) / s. The lever arm c - t cancels what the translation's entries owe to a far origin, so all of it is
    done in float64.
    """
    arm = center.double() - T_object_scene.translation.double()
    J = torch.cat([skew(arm), -torch.eye(3, dtype=torch.float64), -arm[:, None]], 1)
    J = T_object_scene.rotation.double().mT @ J / T_object_scene.scale.double()
    found: Tensor = J @ covariance.double() @ J.mT
    return found


def uncertainty(covariance: Tensor, T_object_scene: Sim3, center: Tensor) -> dict[str, Any]:
    """Standard deviations from the covariance (7, 7); null for an entry that is not a variance.

    center_scene: of the place of the object's center (3,), object frame, along the scene's x, y, z, scene units ·
    rotation_deg: degrees about the object frame's x, y, z · scale_percent: of the scale.
    """
    variances = covariance.diagonal().tolist()
    degrees = [_root(variance) for variance in variances[:3]]
    growth = _root(variances[6])
    return {
        "center_scene": [_root(v) for v in center_covariance(covariance, T_object_scene, center).diagonal().tolist()],
        "rotation_deg": [None if sigma is None else math.degrees(sigma) for sigma in degrees],
        "scale_percent": None if growth is None else 100.0 * growth,
    }


def _root(variance: float) -> float | None:
    return math.sqrt(variance) if 0.0 <= variance < math.inf else None
