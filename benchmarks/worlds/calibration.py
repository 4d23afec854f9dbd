"""How well probabilities hold: a table of what was said of chosen poses, and how many of them were right."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from benchmarks.robust.judging import SUCCESS
from benchmarks.worlds.tables import lower_bound, upper_bound

Array = NDArray[np.float64]
_BINS = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.98, 1.0)
_BOUNDS = (0.8, 0.9, 0.95, 0.98)
_FAR = 0.1


def calibration_table(rows: Sequence[dict[str, Any]], logits: Array) -> str:
    """Markdown. rows: of :mod:`benchmarks.worlds.evidence` · logits: (N,) of the rows, each from a model that has not
    seen the row's world. Only poses that a registration chose count."""
    chosen = np.array([row["winner"] for row in rows])
    probability = 1.0 / (1.0 + np.exp(-logits[chosen]))
    errors = np.array([row["mssd"] for row in rows])[chosen]
    right = errors <= SUCCESS
    lines = [
        f"{len(right)} registrations of {len({row['world'] for row in rows})} worlds, "
        f"{int(right.sum())} with a right pose. AUROC {auroc(probability, right):.4f}, "
        f"expected calibration error {_calibration_error(probability, right):.3f}.",
        "",
        "| probability said | registrations | mean said | right |",
        "|---|---|---|---|",
    ]
    for within, low, high in binned(probability):
        said = f"{probability[within].mean():.3f}" if within.any() else ""
        share = f"{right[within].mean():.3f}" if within.any() else ""
        lines.append(f"| {low} to {high} | {int(within.sum())} | {said} | {share} |")
    lines += [
        "",
        "| accepted at | right poses accepted | at least (95 %) | wrong among the accepted | at most (95 %) "
        "| off by more than 10 % |",
        "|---|---|---|---|---|---|",
    ]
    for bound in _BOUNDS:
        taken = probability >= bound
        hits, total, wrong = int((taken & right).sum()), int(right.sum()), int((taken & ~right).sum())
        among = int(taken.sum())
        lines.append(
            f"| {bound} | {hits} of {total} | {100 * lower_bound(hits, total):.0f} % | {wrong} of {among} "
            f"| {100 * upper_bound(wrong, among):.1f} % | {int((taken & (errors > _FAR)).sum())} |"
        )
    return "\n".join(lines) + "\n"


def measured_line(name: str, rows: Sequence[dict[str, Any]], logits: Array) -> str:
    """Markdown: how many objects that are measured alone, not trained with, are accepted in the right object's place;
    empty of none. name: what they are, a noun."""
    if not rows:
        return ""
    probability = 1.0 / (1.0 + np.exp(-logits[np.array([row["winner"] for row in rows])]))
    accepted = ", ".join(f"{int((probability >= bound).sum())} at {bound}" for bound in _BOUNDS)
    return f"\n{name}, in the right object's place: accepted of {len(probability)}: {accepted}.\n"


def auroc(scores: Array, right: NDArray[np.bool_]) -> float:
    """How often a right pose has the higher score, of all pairs of a right and a wrong one; ties count half."""
    positive, negative = int(right.sum()), int((~right).sum())
    if positive == 0 or negative == 0:
        return float("nan")
    return float((rankdata(scores)[right].sum() - positive * (positive + 1) / 2) / (positive * negative))


def _calibration_error(probability: Array, right: NDArray[np.bool_]) -> float:
    """Mean difference between what was said and what was right over the bins, weighted by their registrations."""
    return sum(
        float(within.mean() * abs(probability[within].mean() - right[within].mean()))
        for within, _, _ in binned(probability)
        if within.any()
    )


def binned(probability: Array) -> list[tuple[NDArray[np.bool_], float, float]]:
    """Which registrations lie in each bin, and its ends."""
    return [
        ((probability >= low) & ((probability < high) | (high == 1.0)), low, high)
        for low, high in itertools.pairwise(_BINS)
    ]
