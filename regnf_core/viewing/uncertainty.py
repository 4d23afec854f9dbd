"""The uncertainty of a pose in degrees, object units and percent, from its covariance."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor

COVARIANCE_ORDERING = ("omega_x", "omega_y", "omega_z", "t_x", "t_y", "t_z", "log_s")
"""What the rows and columns of a covariance belong to: see :attr:`regnf_core.result.RegistrationResult.covariance`."""


def uncertainty(covariance: Tensor) -> dict[str, Any]:
    """Standard deviations, from the diagonal of the (7, 7) covariance; null for an entry that is not a variance.

    rotation_deg: degrees about the object frame's x, y, z · translation: of T_object_scene's, along x, y, z, object
    units · scale_percent: of the scale.
    """
    sigmas = [_root(variance) for variance in covariance.diagonal().tolist()]
    return {
        "rotation_deg": [None if sigma is None else math.degrees(sigma) for sigma in sigmas[:3]],
        "translation": sigmas[3:6],
        "scale_percent": None if sigmas[6] is None else 100.0 * sigmas[6],
    }


def _root(variance: float) -> float | None:
    return math.sqrt(variance) if 0.0 <= variance < math.inf else None
