"""Table 6: every object looked for in every detection, its own and all the others'."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

from benchmarks.robust.cases import KINDS, load_pairs
from benchmarks.robust.judging import FAILED, NOT_AMONG, REJECTED, SUCCESSES, WRONG
from benchmarks.robust.ranking import area_under_roc
from benchmarks.robust.report import Bar, Section, Table, by_group, count, failures_of, of_kind, share_bar, successes
from benchmarks.robust.runs import Context, Job, Run, run_all

NAME = "wrong_objects"
RIGHT_SEEDS = 3
_RIGHT, _WRONG = "right object", "wrong object"


def _least_share(run: Run) -> float:
    return float(min(run["inlier_share_object"], run["inlier_share_scene"], run["explained_share_scene"]))


SCORES: dict[str, Callable[[Run], float]] = {
    "1 - score": lambda run: 1.0 - run["score"],
    "least of the three shares (object, scene, explained)": _least_share,
}
"""Numbers by which right objects can be told from wrong ones without the verdict; no result counts as the least."""


def table(context: Context) -> Table:
    """Wrong objects once each, right ones with three seeds; what was held out apart."""
    runs = run_all(list(_jobs(context)), context)
    right, wrong = of_kind(runs, _RIGHT), of_kind(runs, _WRONG)
    held_out = [run for run in wrong if "held-out" in run["group"]]
    taken = [run for run in wrong if run["category"] == WRONG]
    return Table(
        NAME,
        "Wrong objects",
        [
            _most_bar("wrong objects registered: at most 1 %", taken, wrong),
            _most_bar("of these with a held-out object or scene: at most 1 %", of_those(taken, held_out), held_out),
            share_bar("right objects registered or ambiguous: at least 97 %", successes(right), len(right), 0.97),
        ],
        [
            Section(
                "Wrong objects, one seed. Main rooms and objects are those on which the thresholds were chosen.",
                ("object and detection", "runs", "registered", "ambiguous", "rejected", "no result"),
                [_wrong_row(name, some) for name, some in (*by_group(wrong).items(), ("**all**", wrong))],
            ),
            Section(
                "Right objects.",
                (
                    "detection",
                    "runs",
                    "registered or ambiguous",
                    "registered, pose wrong",
                    "ambiguous, truth not among",
                ),
                [_right_row(name, some) for name, some in by_group(right).items()],
            ),
            Section(
                "Area under the ROC curve of a number that comes with every result, right objects against wrong ones: "
                "the share of all pairs of a right and a wrong run in which the right one has the larger number.",
                ("number", "all", "held out alone"),
                [
                    [name, _area(score, right, wrong), _area(score, of_kind(right, f"{_RIGHT}: held-out"), held_out)]
                    for name, score in SCORES.items()
                ],
            ),
        ],
        runs,
        failures_of(right) + [run for run in wrong if run["category"] not in (REJECTED, FAILED)],
        success="Success: a wrong object `rejected`, or refused for want of surface; a right one `registered` or "
        "`ambiguous` with a pose of at most 5 % MSSD among those listed.",
    )


def of_those(runs: Sequence[Run], among: Sequence[Run]) -> list[Run]:
    """The runs that are in both lists."""
    return [run for run in runs if any(run is other for other in among)]


def _jobs(context: Context) -> Iterator[Job]:
    pairs = {kind.replace(" ", "-"): load_pairs(context.folder, file) for kind, file in KINDS.items()}
    objects = {kind: sorted({pair.object for pair in some}) for kind, some in pairs.items()}
    for kind, detections in pairs.items():
        for pair in detections:
            for seed in range(RIGHT_SEEDS):
                yield Job(pair.case, f"{_RIGHT}: {kind} detection", seed)
            for other_kind, others in objects.items():
                for other in others:
                    if other != pair.object:
                        group = f"{_WRONG}: {other_kind} object, {kind} detection"
                        alike = " (the armchair, its cushion apart)" if {other, pair.object} == {"fc", "fc-nop"} else ""
                        yield Job(partial(pair.with_other, other), group + alike)


def _wrong_row(name: str, runs: Sequence[Run]) -> list[str]:
    counted = [str(count(runs, category)) for category in (WRONG, NOT_AMONG, REJECTED, FAILED)]
    return [name.removeprefix(f"{_WRONG}: "), str(len(runs)), *counted]


def _right_row(name: str, runs: Sequence[Run]) -> list[str]:
    good = sum(run["category"] in SUCCESSES for run in runs)
    others = [str(count(runs, category)) for category in (WRONG, NOT_AMONG)]
    return [name.removeprefix(f"{_RIGHT}: "), str(len(runs)), str(good), *others]


def _most_bar(asked: str, taken: Sequence[Run], runs: Sequence[Run]) -> Bar:
    if not runs:
        return Bar(asked, "none run", False)
    measured = f"{len(taken)}/{len(runs)} ({100 * len(taken) / len(runs):.2f} %)"
    return Bar(asked, measured, len(taken) <= 0.01 * len(runs))


def _area(score: Callable[[Run], float], right: Sequence[Run], wrong: Sequence[Run]) -> str:
    if not right or not wrong:
        return ""
    values = [[score(run) if run["category"] != FAILED else float("-inf") for run in some] for some in (right, wrong)]
    return f"{area_under_roc(*values):.4f}"
