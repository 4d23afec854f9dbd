"""Evenly spread rotations: super-Fibonacci spirals over SO(3) (Alexa 2022), or turns about one axis."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from regnf_core.geometry.quaternions import matrix_from_quaternion
from regnf_core.options import RegistrationOptions
from regnf_core.robust.constants import SEARCH
from regnf_core.surface.cameras import axis_vector

_PHI = math.sqrt(2.0)
_PSI = 1.533751168755204288118041
"""The real root of psi^4 = psi + 4, as published."""


def start_rotations(options: RegistrationOptions, divisor: float = 1.0) -> Tensor:
    """(K, 3, 3) rotations that a search starts from: the option ``rotations`` over ``divisor``, 24 at least.

    They cover all orientations, or are turns about the option ``up_axis``.
    """
    count = max(SEARCH.min_rotations, int(options.robust.rotations / divisor))
    if options.up_axis is None:
        return super_fibonacci(count)
    turns = max(SEARCH.min_rotations, count // SEARCH.rotations_per_turn)
    return turns_about(axis_vector(options.up_axis), turns)


def super_fibonacci(count: int) -> Tensor:
    """(count, 3, 3) float64 rotations, spread over SO(3) with little discrepancy; always the same for a count."""
    s = torch.arange(count, dtype=torch.float64) + 0.5
    r, big_r = (s / count).sqrt(), (1.0 - s / count).sqrt()
    alpha, beta = 2 * math.pi * s / _PHI, 2 * math.pi * s / _PSI
    q = torch.stack([r * alpha.sin(), r * alpha.cos(), big_r * beta.sin(), big_r * beta.cos()], dim=-1)
    return matrix_from_quaternion(q)


def turns_about(axis: Tensor, count: int) -> Tensor:
    """(count, 3, 3) float64 rotations about the unit vector ``axis`` (3,), in equal steps, the identity first."""
    angle = torch.arange(count, dtype=torch.float64, device=axis.device) * (2 * math.pi / count)
    q = torch.cat([(angle / 2).sin().unsqueeze(-1) * axis.double(), (angle / 2).cos().unsqueeze(-1)], dim=-1)
    return matrix_from_quaternion(q)
