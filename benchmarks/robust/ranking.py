"""How well a number that comes with every result tells right objects from wrong ones, whatever the verdict."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.stats import mannwhitneyu

from benchmarks.robust.judging import FAILED
from benchmarks.robust.runs import Run


def area_under_roc(right: Sequence[float], wrong: Sequence[float]) -> float:
    """The share of all pairs of a right and a wrong number in which the right one is larger; equals count half.

    NaN where either is empty.
    """
    if not right or not wrong:
        return float("nan")
    return float(mannwhitneyu(right, wrong).statistic / (len(right) * len(wrong)))


def margin_of(run: Run) -> float:
    """The verdict's margin: the larger, the surer the pose is right; no result counts as the least."""
    return float("-inf") if run["category"] == FAILED else float(run["verdict_margin"])
