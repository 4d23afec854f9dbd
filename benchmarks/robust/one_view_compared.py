"""One depth image, and two objects that differ by a part given as candidates: which of them comes first.

One of them alone cannot be told from the other with something on it. Both are compared in the same detection.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

from benchmarks.robust.cases import Case, Pair, load_pairs, open_field
from benchmarks.robust.judging import judge
from benchmarks.robust.report import Section, by_group, median
from benchmarks.robust.runs import ROBUST, Context, Run, summary
from regnf_core.library import LibraryObject, LibrarySearch, model_object, search_library

OTHERS = {"fc": "fc-nop", "fc-nop": "fc"}
"""The armchair with its cushion and without: what is shown, and what is like it."""
_HEAD = ("shown", "right first", "right first and registered", "the other first and registered", "seconds")

See = Callable[[Pair, int, bool], Case]
"""A pair from one of so many sides, without or with noise."""


def compared(context: Context, see: See, views: int, noises: dict[bool, str]) -> tuple[Section, list[Run]]:
    """The section, and its runs. noises: what the two groups are called."""
    runs = []
    for pair, view, noise in _shown(context.folder, views):
        run = _search(see(pair, view, noise), pair, noises[noise])
        runs.append(run)
        context.show(summary(run))
    rows = [
        [
            name,
            f"{sum(run['place'] == 1 for run in some)}/{len(some)}",
            str(sum(run["place"] == 1 and run["verdict"] == "registered" for run in some)),
            str(sum(run["place"] != 1 and run["verdict"] == "registered" for run in some)),
            f"{median(some, 'seconds'):.1f}",
        ]
        for name, some in by_group(runs).items()
    ]
    return Section("Both chairs given as candidates.", _HEAD, rows), runs


def _shown(folder: Path, views: int) -> Iterator[tuple[Pair, int, bool]]:
    for pair in load_pairs(folder):
        if pair.instance in OTHERS:
            for view in range(views):
                yield from ((pair, view, noise) for noise in (False, True))


def _search(case: Case, pair: Pair, noise: str) -> Run:
    names = (OTHERS[pair.instance], pair.instance)
    begun = time.perf_counter()
    found = search_library(case.scene, case.detection, [_candidate(pair.folder, name) for name in names], ROBUST)
    seconds = time.perf_counter() - begun
    place = 1 + [one.name for one in found.ranking].index(pair.instance)
    return {
        "group": f"{pair.instance}, {noise}",
        "case": case.name,
        "seed": 0,
        "place": place,
        "seconds": seconds,
        **(judge(found.result, case.truth, case.symmetries) if place == 1 else _missed(found)),
    }


@cache
def _candidate(folder: Path, name: str) -> LibraryObject:
    return LibraryObject(name, lambda: open_field(folder, name), model_object(open_field(folder, name), ROBUST.robust))


def _missed(found: LibrarySearch) -> Run:
    first = found.ranking[0]
    return {"verdict": str(first.verdict), "reason": str(first.verdict_reason), "category": "another object first"}
