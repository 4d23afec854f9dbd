"""The pose's 7x7 covariance from the final normal equations.

A fitted field's errors are alike in neighbouring points, so counting samples as independent would promise far too much.
The sandwich estimate sums the gradient over patches of the surface first; each patch counts once.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.robust.extremes import extreme_points
from regnf_core.robust.frame import WorkingFrame
from regnf_core.robust.levenberg import geman_mcclure_weights, normal_equations
from regnf_core.robust.residuals import Residuals
from regnf_core.sim3 import Sim3
from regnf_core.sim3_tangent import skew

_PATCHES = 40
INFLATION = 1.0
"""Factor on the covariance, calibrated on registrations whose truth is known."""


def covariance(r: Residuals, places: Tensor, width: float) -> Tensor:
    """(7, 7) float64 of (omega, dt, log-scale step) for one pose (H = 1), working frames.

    places: (N + M, 3), where the samples lie on the object, by which they are gathered into patches.
    """
    H, _ = normal_equations(r, width)
    n, total = r.scene_count, r.values.shape[1]
    share = torch.cat([torch.full((n,), 1.0 / n), torch.full((total - n,), 1.0 / (total - n))]).double()
    weights = geman_mcclure_weights(r.values[0], width).double() * share
    pull = r.jacobian[0].double() * (weights * r.values[0].double())[:, None]  # (N + M, 7)
    centres = extreme_points(places, _PATCHES)
    patch = torch.cdist(places, centres).argmin(1)
    sums = torch.zeros(centres.shape[0], 7, dtype=torch.float64).index_add_(0, patch, pull)
    count = centres.shape[0]
    meat = sums.T @ sums * (count / max(count - 7, 1))
    bread = torch.linalg.pinv(H[0])
    cov: Tensor = INFLATION * bread @ meat @ bread
    return cov


def in_object_units(cov: Tensor, T_work: Sim3, scene: WorkingFrame, obj: WorkingFrame) -> Tensor:
    """The covariance (7, 7) of the same perturbation (omega, dt, log-scale step) in the fields' own frames.

    A perturbation moves y to t + dt + e^sigma exp(omega)(y - t), t the image of the scene frame's origin: another
    frame, another t.
    """
    origin = ((torch.zeros(3, dtype=torch.float64) - scene.centre) / scene.length)[None]
    arm = T_work.apply(origin)[0] - T_work.translation
    L = torch.eye(7, dtype=torch.float64)
    L[3:6, 3:6] *= obj.length
    L[3:6, 0:3] = -obj.length * skew(arm)
    L[3:6, 6] = obj.length * arm
    return L @ cov @ L.T
