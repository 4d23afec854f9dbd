"""Whether a network began as the distance to a sphere (Atzmon and Lipman 2020): what is left of it after training."""

from __future__ import annotations

import math

from regnf_core.importing.arrays import Float32Array

_TOSSES = 30
"""So many tosses of a coin that fall alike are no chance."""


def began_as_a_sphere(last: Float32Array) -> bool:
    """Whether the signs of the last layer's weights show it: all begin at sqrt(pi / width).

    Other starts give either sign alike. Training to distances, which grow outwards, prefers one sign in the distance's
    row, but in none of the features'. last: (rows, width), the distance's row first.
    """
    mostly = [float((row > 0).mean()) for row in (last[:1], last[1:]) if row.size]
    alike = len({share > 0.5 for share in mostly}) == 1
    return len(mostly) == 2 and alike and min(_tosses(last[:1]), _tosses(last[1:])) > _TOSSES


def _tosses(weights: Float32Array) -> float:
    """So many tosses of a coin fall alike as rarely as these signs are by chance, or more so (Chernoff's bound)."""
    share = min(0.5, 1.0 - float(max((weights > 0).mean(), (weights < 0).mean())))
    entropy = -sum(part * math.log2(part) for part in (share, 1.0 - share) if part > 0.0)
    return weights.size * (1.0 - entropy)
