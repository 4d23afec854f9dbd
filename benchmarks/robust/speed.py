"""Table 9: seconds a pair, with one and two threads, beside the preset `paper`."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from benchmarks.robust.cases import FULL_SIZE, MAIN, load_pairs
from benchmarks.robust.fresh import in_fresh_process
from benchmarks.robust.report import Bar, Section, Table, by_group, failures_of, median, successes
from benchmarks.robust.runs import Context, Run

NAME = "speed"
THREADS = (1, 2)
SEEDS = 3
LIMITS = {"small tables": 2.5, "full size": 5.0}
"""Bars with two threads, seconds."""
FASTER = 20.0


def table(context: Context) -> Table:
    """A fresh process for every number of threads; every pair with three seeds of `robust` and one of `paper`."""
    runs: list[Run] = []
    for threads in THREADS:
        for size, file in (("small tables", MAIN), ("full size", FULL_SIZE)):
            if not load_pairs(context.folder, file):
                continue
            limit = str(context.limit or 1000)
            found = in_fresh_process(
                "benchmarks.robust.speed_process", threads, str(context.folder), file, str(SEEDS), limit
            )
            runs += [{**run, "preset": run["group"], "group": f"{size}, {threads} thread(s)"} for run in found]
    return Table(
        NAME,
        "Seconds a pair",
        [bar for name, some in by_group(runs).items() for bar in _bars(name, some)],
        [
            Section(
                "Medians over all pairs and seeds, in one process for each row, the presets in turns; fields open "
                "already. Times faster: the median over the pairs of `paper`'s seconds by the median of `robust`'s.",
                ("fields", "robust s", "worst", "paper s", "times faster", "right: robust", "right: paper"),
                [_row(name, some) for name, some in by_group(runs).items()],
            ),
            Section(
                "`robust` by phase, seconds, medians.",
                ("fields", *PHASES),
                [
                    [name, *(f"{median(of_preset(some, 'robust'), 'seconds_' + phase):.2f}" for phase in PHASES)]
                    for name, some in by_group(runs).items()
                ],
            ),
        ],
        runs,
        failures_of(of_preset(runs, "robust")),
    )


PHASES = ("sampling", "initializing", "optimizing", "verifying", "exporting")


def of_preset(runs: Sequence[Run], preset: str) -> list[Run]:
    """The runs of one preset."""
    return [run for run in runs if run["preset"] == preset]


def times_faster(runs: Sequence[Run]) -> float:
    """The median over the pairs of the seconds of `paper` by those of `robust`."""
    ratios = []
    for some in by_group(runs, "case").values():
        ratios.append(median(of_preset(some, "paper"), "seconds") / median(of_preset(some, "robust"), "seconds"))
    return statistics.median(ratios)


def _bars(name: str, runs: Sequence[Run]) -> list[Bar]:
    size, threads = name.split(", ")
    bars = []
    if threads.startswith("2"):
        taken = median(of_preset(runs, "robust"), "seconds")
        bars.append(Bar(f"{name}: at most {LIMITS[size]:g} s", f"{taken:.2f} s", taken <= LIMITS[size]))
    ratio = times_faster(runs)
    bars.append(Bar(f"{name}: at least {FASTER:g} times faster than paper", f"{ratio:.1f} times", ratio >= FASTER))
    return bars


def _row(name: str, runs: Sequence[Run]) -> list[str]:
    robust, paper = of_preset(runs, "robust"), of_preset(runs, "paper")
    return [
        name,
        f"{median(robust, 'seconds'):.2f}",
        f"{max(run['seconds'] for run in robust):.2f}",
        f"{median(paper, 'seconds'):.1f}",
        f"{times_faster(runs):.1f}",
        f"{successes(robust)}/{len(robust)}",
        f"{successes(paper)}/{len(paper)}",
    ]
