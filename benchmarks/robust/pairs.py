"""Table 1: every pair, several seeds, no up axis."""

from __future__ import annotations

from benchmarks.robust.cases import KINDS, load_pairs
from benchmarks.robust.report import Bar, Table, accuracy_section, failures_of, median, of_kind, share_bar, successes
from benchmarks.robust.runs import Context, Job, run_all

NAME = "pairs"
HELD_OUT_SEEDS = 3


def table(context: Context) -> Table:
    """The main pairs, and the held-out ones apart."""
    jobs = [
        Job(pair.case, f"{kind}: {pair.name}", seed)
        for kind, file in KINDS.items()
        for pair in load_pairs(context.folder, file)
        for seed in range(context.seeds if kind == "main" else min(context.seeds, HELD_OUT_SEEDS))
    ]
    runs = run_all(jobs, context)
    main, held_out = of_kind(runs, "main"), of_kind(runs, "held out")
    mssd, turn, asked = (median(main, key) for key in ("mssd_share", "rotation_error_rad", "field_evaluations"))
    return Table(
        NAME,
        "Every pair",
        [
            share_bar("main pairs: all", successes(main), len(main), 1.0),
            Bar("median MSSD at most 0.5 % of the diameter", f"{100 * mssd:.3f} %", mssd <= 0.005),
            Bar("median rotation error at most 0.003 rad", f"{turn:.4f} rad", turn <= 0.003),
            Bar("median evaluations at most 150,000", f"{asked:,.0f}", asked <= 150_000),
            share_bar("held-out pairs (no bar set): all", successes(held_out), len(held_out), 1.0),
        ],
        [
            accuracy_section("The main pairs, on which the thresholds were chosen.", "pair", main),
            accuracy_section(
                f"Held out: other objects, in scenes of their own; at most {HELD_OUT_SEEDS} seeds.", "pair", held_out
            ),
        ],
        runs,
        failures_of(runs),
    )
