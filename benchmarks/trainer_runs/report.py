"""The table of the comparison."""

from __future__ import annotations

import math
from collections.abc import Sequence

from benchmarks.trainer_runs.compare import Outcome

_HEAD = (
    "| trainer | runs | within 1e-5 | within 1e-3 | wrong, untold | refused or asked | s (median) | colors read"
    " | largest error | reasons |"
)


def table(outcomes: Sequence[Outcome]) -> str:
    """One row a trainer, and one for all."""
    names = list(dict.fromkeys(outcome.trainer for outcome in outcomes))
    rows = [_row(name, [o for o in outcomes if o.trainer == name]) for name in names]
    return "\n".join([_HEAD, "|---" * 10 + "|", *rows, _row("all", outcomes)])


def _row(name: str, outcomes: Sequence[Outcome]) -> str:
    counts = {kind: sum(o.kind == kind for o in outcomes) for kind in ("exact", "right", "wrong", "refused")}
    seconds = sorted(o.seconds for o in outcomes)[len(outcomes) // 2]
    reasons = [o.reason for o in outcomes if o.reason]
    told = ", ".join(f"{reason} {reasons.count(reason)}" for reason in sorted(set(reasons)))
    within = counts["exact"] + counts["right"]
    return (
        f"| {name} | {len(outcomes)} | {counts['exact']} | {within} | {counts['wrong']} | {counts['refused']}"
        f" | {seconds:.1f} | {_colors(outcomes)} | {told} |"
    )


def _colors(outcomes: Sequence[Outcome]) -> str:
    """How many of the colors that were written were read, of fields that were, and the largest error of these."""
    written = [o.color_error for o in outcomes if not math.isnan(o.color_error)]
    read = [error for error in written if math.isfinite(error)]
    return f"{len(read)} of {len(written)} | {max(read):.1e}" if read else f"0 of {len(written)} | none"
