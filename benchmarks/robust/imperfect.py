"""Table 13: fields fitted to posed images, and what is left when they saw little or learned little.

FIELDS is the folder of benchmarks.make_image_fields.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from benchmarks.robust.cases import MAIN, Case, Pair, load_pairs
from benchmarks.robust.judging import AMONG, FAILED, NOT_AMONG, REJECTED, RIGHT, SUCCESSES, WRONG
from benchmarks.robust.published import (
    MEAN_OF_SOLVED,
    PUBLISHED,
    SINGLE_VIEW_TRANSLATION,
    UNSOLVED,
    Errors,
    better,
    in_words,
    mean_errors,
    paper_errors,
)
from benchmarks.robust.report import Bar, Section, Table, by_group, count, failures_of, median, share_bar, successes
from benchmarks.robust.runs import Context, Job, Run, run_all

NAME, UNOBSERVED = "imperfect", "unobserved"


@dataclass(frozen=True)
class Kind:
    """A way to see or to learn a room: what it is called, its list of pairs, the room names' ending, the bar set."""

    name: str
    file: str
    suffix: str
    least: float | None


LONG = Kind("long walk", MAIN, "", 1.0)
SHORT = Kind("short walk", "pairs-short.json", "-short", 0.95)
SINGLE = Kind("single view", "pairs-single.json", "-single", None)
PERCENTS = tuple(
    Kind(f"{percent} % of the training", f"pairs-after-{percent}-percent.json", f"-after-{percent}-percent", least)
    for percent, least in ((1, 0.60), (3, 0.85), (10, 0.95))
)
KINDS = (LONG, SHORT, SINGLE, *PERCENTS)
_FEWER = 3  # times fewer seeds than of the long walks
_WITHIN = (0.02, 0.05, 0.10)
_SINGLE_CHAIRS = 4  # of the five, on which one view shall do better than the paper's several


def pairs_by_kind(folder: Path) -> Iterator[tuple[Kind, Pair]]:
    """Every pair whose list is in the folder."""
    for kind in KINDS:
        for pair in load_pairs(folder, kind.file):
            yield kind, pair


def table(context: Context) -> Table:
    """All lists of pairs that the folder has."""
    return table_of(context, NAME, "Imperfect fields", Pair.case)


def unobserved_table(context: Context) -> Table:
    """The same without what the fields say was seen of them."""
    title = "Imperfect fields that do not say what was seen of them"
    return table_of(context, UNOBSERVED, title, lambda pair: pair.case().unobserved())


def table_of(context: Context, name: str, title: str, make: Callable[[Pair], Case]) -> Table:
    """All lists of pairs that the folder has; ``make``: the case that a pair is tried as."""
    jobs = [
        Job(partial(make, pair), kind.name, seed)
        for kind, pair in pairs_by_kind(context.folder)
        for seed in range(context.seeds if kind is LONG else max(1, context.seeds // _FEWER))
    ]
    runs = run_all(jobs, context, paper_errors)
    return Table(
        name,
        title,
        list(_bars(runs)),
        [
            Section(
                "By what the scene's field was given.", _HEAD, [_row(name, r) for name, r in by_group(runs).items()]
            ),
            *(
                Section(f"{name}, pair by pair.", _HEAD, [_row(case, r) for case, r in by_group(some, "case").items()])
                for name, some in by_group(runs).items()
            ),
            Section(
                "The paper's metrics: translation RMSE (object units) / RMSE of the Euler angles (radians) / |scale - "
                "true scale|, means over all runs whatever their verdict, of the pose returned that is nearest to the "
                "truth or to one of its equals by the object's symmetry. The paper's figures are from other rooms and "
                "objects of the same kinds.",
                ("pair", *(kind.name for kind in KINDS), "paper, several views", "paper, one view (translation)"),
                [_paper_row(room, name, runs) for room, name in PUBLISHED],
            ),
        ],
        runs,
        failures_of(runs),
    )


_HEAD = (
    "",
    "success",
    RIGHT,
    AMONG,
    "rejected or failed",
    NOT_AMONG,
    WRONG,
    *(f"MSSD at most {100 * share:.0f} %" for share in _WITHIN),
    "MSSD % median",
    "score median",
    "seconds",
)


def _row(name: str, runs: Sequence[Run]) -> list[str]:
    lost = count(runs, REJECTED) + count(runs, FAILED)
    return [
        name,
        f"{successes(runs)}/{len(runs)}",
        str(count(runs, RIGHT)),
        str(count(runs, AMONG)),
        str(lost),
        str(count(runs, NOT_AMONG)),
        str(count(runs, WRONG)),
        *(str(sum(run.get("mssd_share", float("inf")) <= share for run in runs)) for share in _WITHIN),
        f"{100 * median(runs, 'mssd_share'):.2f}",
        f"{median(runs, 'score'):.3f}",
        f"{median(runs, 'seconds'):.1f}",
    ]


def of_pair(runs: Sequence[Run], kind: Kind, room: str, name: str) -> list[Run]:
    """The runs of one kind on one pair; a single view's room is named after its object too."""
    ending = f"-{name}" if kind is SINGLE else ""
    case = f"{room}{kind.suffix}{ending} {name}"
    return [run for run in runs if run["group"] == kind.name and run["case"] == case]


def _paper_row(room: str, name: str, runs: Sequence[Run]) -> list[str]:
    ours = [in_words(mean_errors(of_pair(runs, kind, room, name))) for kind in KINDS]
    once = f"{SINGLE_VIEW_TRANSLATION[name]:.3f}" if (room, name) in PUBLISHED and room == "ac-room" else ""
    return [f"{room} {name}", *ours, in_words(PUBLISHED[room, name]), once]


def _bars(runs: Sequence[Run]) -> Iterator[Bar]:
    for kind in KINDS:
        some = [run for run in runs if run["group"] == kind.name]
        if some and kind.least is not None:
            yield share_bar(f"{kind.name}: at least {100 * kind.least:.0f} %", successes(some), len(some), kind.least)
    taken = [run for run in runs if run["category"] == WRONG]
    yield Bar("none registered wrong", f"{len(taken)} of {len(runs)}", not taken)
    found = {pair: mean_errors(of_pair(runs, LONG, *pair)) for pair in PUBLISHED}
    if any(found.values()):
        ahead = sum(better(ours, PUBLISHED[pair]) for pair, ours in found.items())
        run = sum(ours is not None for ours in found.values())
        yield Bar("long walk: all three errors below the paper's on every pair", f"{ahead} of {run}", ahead == run)
        yield _mean_bar([ours for pair, ours in found.items() if ours is not None and pair not in UNSOLVED])
    single = {name: mean_errors(_given(of_pair(runs, SINGLE, "ac-room", name))) for name in SINGLE_VIEW_TRANSLATION}
    if any(run["group"] == SINGLE.name for run in runs):
        ahead = sum(better(ours, PUBLISHED["ac-room", name]) for name, ours in single.items())
        yield Bar(
            f"single view: poses given below the paper's several views on at least {_SINGLE_CHAIRS} of 5 chairs",
            f"{ahead} of {len(single)}",
            ahead >= _SINGLE_CHAIRS,
        )


def _given(runs: Sequence[Run]) -> list[Run]:
    """The runs that gave a pose out: all that were not rejected."""
    return [run for run in runs if run["category"] in (*SUCCESSES, WRONG, NOT_AMONG)]


def _mean_bar(found: Sequence[Errors]) -> Bar:
    mean = Errors(*(statistics.fmean(values) for values in zip(*found, strict=True))) if found else None
    third = Errors(*(value / 3 for value in MEAN_OF_SOLVED))
    return Bar(
        f"long walk: mean over the pairs that the paper solves at most a third of the paper's ({in_words(third)})",
        in_words(mean),
        better(mean, third),
    )
