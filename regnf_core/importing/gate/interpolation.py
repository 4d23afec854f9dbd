"""Linear or smoothstep: how a hash grid was interpolated in training, told from the gradient within its cells.

Smoothstep modulates a level's slope within each cell; training makes the other levels cancel that. So under the
interpolation of training the rest of the gradient's norm does not follow the difference between the two
interpolations, and under the other one it makes up for all of it. And only as it was in training does a level's part
correct what the coarser levels leave at every place of a cell. One of both has to be clear, and the other one must not
speak against it. A field that was trained too shortly does not tell.
"""

from __future__ import annotations

from torch import Tensor

from regnf_core.importing.gate.evidence import LEAST_SUPPORT, Trial
from regnf_core.schema.hash_grid_config import Interpolation

_TRAINED = 0.08
"""Only a field whose gradient is this near to 1 tells that it was interpolated linearly: one that was trained for
shorter under smoothstep looks like that, too."""
_SMOOTH, _LINEAR = 0.15, -0.3
"""How much more the norm follows the difference under linear than under smoothstep, at least or at most."""
_NEAR = 1.0
_CLEAR = 2.0 * LEAST_SUPPORT
"""Chance is not all of the difference: both readings have the right rows, and linear interpolation is less noisy. Of
fields trained for 150 steps the wrong one was ahead by 14 at most."""
_AGAINST = -3.0
"""Standard errors by which no level may speak against what the others tell."""


def told_interpolation(linear: Trial, smoothstep: Trial) -> Interpolation | None:
    """How the grid was interpolated, by one reading's trials under both; None where they do not tell."""
    by_norm = _told_by_norm(linear, smoothstep)
    if by_norm is None:
        return _told_by_levels(linear, smoothstep)
    one, other = (linear, smoothstep) if by_norm == "linear" else (smoothstep, linear)
    return by_norm if one.support_over(other) > -LEAST_SUPPORT else None


def _told_by_levels(linear: Trial, smoothstep: Trial) -> Interpolation | None:
    if _is_corrected(linear, smoothstep):
        return "linear"
    return "smoothstep" if _is_corrected(smoothstep, linear) else None


def _is_corrected(one: Trial, other: Trial) -> bool:
    if one.levels is None or other.levels is None or one.support_over(other) < _CLEAR:
        return False
    return float(one.levels.over(other.levels).in_errors().min()) > _AGAINST


def _told_by_norm(linear: Trial, smoothstep: Trial) -> Interpolation | None:
    if linear.gradient is None or smoothstep.gradient is None:
        return None
    more = _share_undone(smoothstep.gradient, linear.gradient) - _share_undone(linear.gradient, smoothstep.gradient)
    if more > _SMOOTH:
        return "smoothstep"
    if more < _LINEAR and linear.mean < _TRAINED:
        return "linear"
    return None


def _share_undone(gradient: Tensor, other: Tensor) -> float:
    """Slope of the norm of ``gradient`` over what the ``other`` one would add to it: 0 under the right one."""
    norm = gradient.norm(dim=-1).clamp_min(1e-6)
    added = ((other - gradient) * gradient).sum(dim=-1) / norm
    kept = ((norm - 1.0).abs() < _NEAR) & (added.abs() < _NEAR)
    added, beyond = added[kept] - added[kept].mean(), norm[kept] - norm[kept].mean()
    return float((added * beyond).sum() / added.square().sum().clamp_min(1e-12))
