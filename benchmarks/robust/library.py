"""Table 11: the right object among 8 and 64, and the time that takes beside one registration."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np

from benchmarks.robust.cases import HELD_OUT, MAIN, Case, Pair, load_pairs, open_field
from benchmarks.robust.judging import judge
from benchmarks.robust.report import Bar, Section, Table, by_group, failures_of, median, share_bar
from benchmarks.robust.runs import ROBUST, Context, Run
from regnf_core import open_field as open_safe_field
from regnf_core import register
from regnf_core.library import LibraryObject, LibrarySearch, rank_by_signature, read_object_model, search_library
from regnf_core.robust.scene import view_scene

NAME = "library"
SIZES = (8, 64)


def table(context: Context) -> Table:
    """Every detection searched in the whole library and in random parts of it that hold the right object."""
    library = _library(context.folder)
    runs = []
    for kind, file in (("main", MAIN), ("held out", HELD_OUT)):
        for pair in load_pairs(context.folder, file):
            for seed in range(min(context.seeds, 3)):
                for size in SIZES:
                    runs.append(_search(kind, pair, library, size, seed))
                    context.show(f"{runs[-1]['group']} {runs[-1]['case']}: place {runs[-1]['place']}")
    groups = by_group(runs)
    rows = [
        [
            name,
            f"{sum(run['place'] == 1 for run in some)}/{len(some)}",
            f"{sum(run['place'] <= 3 for run in some)}/{len(some)}",
            f"{max(run['signature_place'] for run in some)}",
            f"{median(some, 'seconds'):.2f}",
            f"{median(some, 'seconds_one'):.2f}",
            f"{median(some, 'times_one'):.2f}",
        ]
        for name, some in groups.items()
    ]
    full = [run for run in runs if run["size"] == max(SIZES)]
    ratio = median(full, "times_one")
    head = ("library", "right first", "among three", "worst place by signature", "seconds", "one registration", "times")
    return Table(
        NAME,
        "Library search",
        [
            share_bar("64 objects: right one first at least 95 %", sum(r["place"] == 1 for r in full), len(full), 0.95),
            Bar("64 objects: at most 4 times one registration", f"{ratio:.2f} times (median)", ratio <= 4.0),
        ],
        [
            Section(
                "Models are stored, fields opened when asked for; both times include the clouds for viewers.",
                head,
                rows,
            )
        ],
        runs,
        [run for run in runs if run["place"] != 1 or failures_of([run])],
        success="The right object comes first in the ranking.",
    )


@cache
def _library(folder: Path) -> dict[str, LibraryObject]:
    entries = json.loads((folder / "library" / "library.json").read_text())
    return {
        one["name"]: LibraryObject(
            one["name"],
            partial(open_safe_field, folder / one["field"]),
            read_object_model(folder / "library" / one["model"]),
        )
        for one in entries
    }


def _search(kind: str, pair: Pair, library: dict[str, LibraryObject], size: int, seed: int) -> Run:
    case = pair.case()
    right = library[pair.instance]
    some = _part([one for one in library.values() if one is not right], size - 1, seed)
    some.insert(seed % size, right)
    begun = time.perf_counter()
    found = search_library(case.scene, case.detection, some, ROBUST, seed)
    seconds = time.perf_counter() - begun
    begun = time.perf_counter()
    register(
        case.scene,
        open_field(pair.folder, pair.object),
        case.detection,
        ROBUST,
        seed,
        object_model=right.model,
    )
    alone = time.perf_counter() - begun
    place = 1 + [one.name for one in found.ranking].index(pair.instance)
    judged = judge(found.result, case.truth, case.symmetries) if place == 1 else _missed(found)
    return {
        "group": f"{kind}, {size} objects",
        "case": f"{pair.name}, first: {found.ranking[0].name}",
        "seed": seed,
        "size": size,
        "place": place,
        "signature_place": _signature_place(case, pair, some),
        "seconds": seconds,
        "seconds_one": alone,
        "times_one": seconds / alone,
        **judged,
    }


def _missed(found: LibrarySearch) -> Run:
    first = found.ranking[0]
    return {"verdict": str(first.verdict), "reason": str(first.verdict_reason), "category": "another object first"}


def _signature_place(case: Case, pair: Pair, some: Sequence[LibraryObject]) -> int:
    view = view_scene(case.scene, case.detection, ROBUST.robust)
    order = rank_by_signature(view, [one.model for one in some])
    return 1 + [some[number].name for number, _ in order].index(pair.instance)


def _part(others: list[LibraryObject], count: int, seed: int) -> list[LibraryObject]:
    chosen = np.random.default_rng(seed).permutation(len(others))[:count]
    return [others[i] for i in chosen]
