"""Opacity along rays from signed distances (Wang et al. 2021, "NeuS")."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid


def render_weights(distances: Tensor, sharpness: Tensor | float) -> tuple[Tensor, Tensor]:
    """What each of a ray's S - 1 sections counts, (R, S - 1), and what passes all of them, (R,).

    distances: (R, S), signed distances at consecutive points of each ray · sharpness: s of the logistic function, per
    field unit. Equation 13, alpha_i = max((Phi_s(f_i) - Phi_s(f_i+1)) / Phi_s(f_i), 0), in logarithms, so that a point
    deep in matter does not divide by zero: what passes sections 1 to i is the product of their 1 - alpha.
    Weights and rest sum to 1.
    """
    logarithm = logsigmoid(sharpness * distances)
    passed = (logarithm[:, 1:] - logarithm[:, :-1]).clamp_max(0.0).cumsum(dim=1).exp()
    before = torch.cat((torch.ones_like(passed[:, :1]), passed[:, :-1]), dim=1)
    return before - passed, passed[:, -1]


def least_sharpness(share: float, size: float) -> float:
    """The sharpness below which the learned one may not fall after ``share`` of the fit, per field unit.

    It grows from 20 to 400 over the diagonal ``size``: blurred at first, so that every section on a ray learns, and at
    last narrower than a hundredth of the diagonal whatever was learned.
    """
    return 20.0 * math.exp(math.log(20.0) * min(max(share, 0.0), 1.0)) / size
