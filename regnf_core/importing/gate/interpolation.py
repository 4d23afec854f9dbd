"""Linear or smoothstep: how a hash grid was interpolated in training, told from what its levels do for the gradient.

Smoothstep modulates a level's slope within each cell. Only as it was in training does the level's part correct what the
coarser levels leave at every place of a cell. A field that was trained too shortly does not tell.
"""

from __future__ import annotations

from regnf_core.importing.gate.evidence import LEAST_SUPPORT, Trial
from regnf_core.schema.hash_grid_config import Interpolation

_CLEAR = 2.0 * LEAST_SUPPORT
"""Chance is not all of the difference: both readings have the right rows, and linear interpolation is less noisy. Of
fields trained for 150 steps the wrong one was ahead by 14 at most."""
_AGAINST = -3.0
"""Standard errors by which no level may speak against what the others tell."""


def told_interpolation(linear: Trial, smoothstep: Trial) -> Interpolation | None:
    """How the grid was interpolated, by one reading's trials under both; None where they do not tell."""
    if _is_told(linear, smoothstep):
        return "linear"
    return "smoothstep" if _is_told(smoothstep, linear) else None


def _is_told(one: Trial, other: Trial) -> bool:
    if one.levels is None or other.levels is None or one.support_over(other) < _CLEAR:
        return False
    return float(one.levels.over(other.levels).in_errors().min()) > _AGAINST
