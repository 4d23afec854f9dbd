"""The choice among readings by how far the gradient's norm is from 1 on average, and by usual numbers.

Readings that fit clearly worse than the best are out. Those left that are one function need no choice. Of the others
the most usual one is taken if it alone is so usual and the rest lie so near it that it is no accident.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from regnf_core.importing.cost.calls import FINALISTS
from regnf_core.importing.gate.evidence import CLEARLY, LEAST, Evidence, Trial

_FINALLY = 0.04
"""In the second round, at more points, a reading is out that fits worse by this share of the best's misfit."""
_ACCIDENT = 0.5 * math.log(2.0)
"""Usual numbers are powers of two: among layouts spread by less than this (log of the finest resolution), one of them
is no accident."""


def chosen_by_misfit(trials: Sequence[Trial], finest: Evidence) -> tuple[Trial | None, list[Trial]]:
    """The reading that the misfit and its numbers tell, or None where they do not; and all that fit as well.

    finest: more points, near the surface of the reading that fits best.
    """
    best = min(trials, key=lambda trial: trial.mean)
    left = [trial for trial in trials if not best.is_distance or not best.is_better(trial, CLEARLY, LEAST)]
    if best.is_distance and len(left) > 1 and not all(trial.is_same(best) for trial in left):
        left = _second_round(left, finest)
    usual = min(left, key=lambda trial: (trial.reading.tier, trial.mean))
    others = [trial for trial in left if not trial.is_same(usual)]
    return (usual if _is_no_accident(usual, others) else None), [usual, *others]


def _second_round(trials: Sequence[Trial], finest: Evidence) -> list[Trial]:
    """Those of ``trials`` that are as good as the best of them at more points. The least usual ones are not asked."""
    finalists = sorted(trials, key=lambda trial: (trial.reading.tier, trial.mean))[:FINALISTS]
    again = [finest.of(trial.reading) for trial in finalists]
    best = min(again, key=lambda trial: trial.mean)
    return [trial for trial in again if not best.is_better(trial, _FINALLY)]


def _is_no_accident(usual: Trial, others: Sequence[Trial]) -> bool:
    """Whether ``usual`` is the only one, or of numbers so usual that its place among the others is no chance."""
    if not others:
        return True
    scales = [trial.reading.scale for trial in (usual, *others)]
    told = [scale for scale in scales if scale is not None]
    if usual.reading.tier > 0 or any(trial.reading.tier == 0 for trial in others) or len(told) < len(scales):
        return False
    return max(told) - min(told) <= _ACCIDENT
