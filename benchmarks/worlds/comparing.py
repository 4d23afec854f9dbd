"""The right object and another one: which of them comes first by what candidates are compared by.

It is computed from the two registrations. The quick comparison with which a search among many objects begins is not in
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.robust.judging import SUCCESS
from regnf_core.robust.constants import VERDICT

Case = tuple[str, int]


def compared_line(asked: str, rows: Sequence[dict[str, Any]], odds: NDArray[np.float64]) -> str:
    """Markdown: in how many cases the right object, at a right pose, comes before the one that was ``asked`` for in
    its box too; empty of none. Rejected ones come last, then what candidates are compared by counts.

    rows: of :mod:`benchmarks.worlds.evidence`, those with a verdict · odds: (N,) of a pose alone.
    """
    best: dict[str, dict[Case, tuple[bool, float]]] = {"right": {}, "other": {}}
    for row, alone in zip(rows, odds, strict=True):
        if not row["winner"] or "verdict" not in row or (row["model"] != asked and row["mssd"] > SUCCESS):
            continue
        rank = row["verdict"] == "rejected", float(VERDICT.log_odds_per_score * row["score"] - alone)
        best["other" if row["model"] == asked else "right"][row["world"], row["case"]] = rank
    both = best["right"].keys() & best["other"].keys()
    if not both:
        return ""
    first = sum(best["right"][case] < best["other"][case] for case in both)
    return f"By what candidates are compared by, the right object comes first in {first} of {len(both)}.\n"
