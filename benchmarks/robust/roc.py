"""Table 14: how well the verdict's margin tells right objects from wrong ones on fields fitted to posed images.

FIELDS is the folder of benchmarks.make_image_fields.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

from benchmarks.robust.imperfect import pairs_by_kind
from benchmarks.robust.judging import FAILED, NOT_AMONG, REJECTED, SUCCESSES, WRONG
from benchmarks.robust.ranking import area_under_roc, margin_of
from benchmarks.robust.report import Bar, Section, Table, by_group, count, of_kind
from benchmarks.robust.runs import Context, Job, Run, run_all

NAME = "roc"
_RIGHT, _WRONG = "right object", "wrong object"
_LEAST_AREA, _MOST_TAKEN = 0.995, 0.01


def table(context: Context) -> Table:
    """Every object in every detection of every list of pairs that the folder has; right ones with several seeds."""
    runs = run_all(list(_jobs(context)), context)
    kinds = by_group([{**run, "kind": run["group"].split(": ", 1)[1]} for run in runs], "kind")
    right, wrong = _parted(runs)
    taken = [run for run in wrong if run["category"] == WRONG]
    area = _area(right, wrong)
    return Table(
        NAME,
        "Right and wrong objects on imperfect fields",
        [
            Bar(f"area under the ROC curve at least {_LEAST_AREA}", f"{area:.4f}", area >= _LEAST_AREA),
            Bar(
                f"wrong objects registered: at most {100 * _MOST_TAKEN:.0f} %",
                f"{len(taken)}/{len(wrong)}",
                len(taken) <= _MOST_TAKEN * len(wrong),
            ),
        ],
        [
            Section(
                "The area is the share of all pairs of a right and a wrong run in which the right one has the larger "
                "verdict_margin; runs without a result have the least. Found: right objects whose pose is within 5 % "
                "MSSD, whatever the verdict.",
                _HEAD,
                [_row(name, some) for name, some in (*kinds.items(), ("**all**", runs))],
            )
        ],
        runs,
        [run for run in right if run["category"] not in SUCCESSES]
        + [run for run in wrong if run["category"] not in (REJECTED, FAILED)],
        success="Success: a wrong object `rejected`, or refused for want of surface; a right one `registered` or "
        "`ambiguous` with a pose of at most 5 % MSSD among those listed.",
    )


_HEAD = (
    "scene",
    "area, all right runs",
    "area, found ones",
    "right runs",
    "successes",
    "least verdict_margin of the found",
    "wrong runs",
    "registered",
    "ambiguous",
    "largest verdict_margin of the wrong",
)


def _row(name: str, runs: Sequence[Run]) -> list[str]:
    right, wrong = _parted(runs)
    found = [run for run in right if run.get("mssd_share", 1.0) <= 0.05]
    return [
        name,
        f"{_area(right, wrong):.4f}",
        f"{_area(found, wrong):.4f}",
        str(len(right)),
        str(sum(run["category"] in SUCCESSES for run in right)),
        _extreme(min, found),
        str(len(wrong)),
        str(count(wrong, WRONG)),
        str(count(wrong, NOT_AMONG)),
        _extreme(max, wrong),
    ]


def _extreme(choose: Callable[[list[float]], float], runs: Sequence[Run]) -> str:
    values = [margin_of(run) for run in runs if run["category"] != FAILED]
    return f"{choose(values):.3f}" if values else ""


def _area(right: Sequence[Run], wrong: Sequence[Run]) -> float:
    return area_under_roc([margin_of(run) for run in right], [margin_of(run) for run in wrong])


def _parted(runs: Sequence[Run]) -> tuple[list[Run], list[Run]]:
    return of_kind(runs, _RIGHT), of_kind(runs, _WRONG)


def _jobs(context: Context) -> Iterator[Job]:
    pairs = list(pairs_by_kind(context.folder))
    objects = sorted({pair.object for _, pair in pairs})
    for kind, pair in pairs:
        for seed in range(context.seeds):
            yield Job(pair.case, f"{_RIGHT}: {kind.name}", seed)
        for other in objects:
            if other != pair.object:
                yield Job(partial(pair.with_other, other), f"{_WRONG}: {kind.name}")
