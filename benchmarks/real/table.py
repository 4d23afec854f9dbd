"""Runs as a table: one line a thing, one column a kind of object."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from math import degrees

from benchmarks.robust.runs import Run

_GROUP = ("halves", "map", "observation", "object")


def line(run: Run) -> str:
    """A run to follow the progress by."""
    group = " ".join(str(run[name]) for name in _GROUP)
    text = f"{group} | {run['group']} seed {run['seed']}: {run['verdict']} ({run['reason']})"
    if "mssd_share" in run:
        text += f", {errors(run)}"
    lost = f", lost by: {run['lost_by']}, {_stages(run)}" if "lost_by" in run else ""
    return f"{text}, {run['seconds']:.1f} s{lost}"


def errors(run: Run) -> str:
    """Of the rotation, of the place of the object's center (share of its diameter), of the scale, and MSSD."""
    if "mssd_share" not in run:
        return "none"
    return (
        f"{degrees(run['rotation_error_rad']):.1f} deg, {100.0 * run['center_error_share']:.1f} %, "
        f"scale {100.0 * (run['scale_ratio'] - 1.0):+.1f} %, MSSD {100.0 * run['mssd_share']:.1f} %"
    )


def _stages(run: Run) -> str:
    names = ("truth_moves_to", "nearest_seed", "nearest_feature", "nearest_searched", "nearest_refined", "chosen")
    told = ", ".join(f"{name} {run[name]:.3f}" for name in names if name in run)
    if "after_search_stages" in run:
        pairs = zip(run["search_scores_truth"], run["search_scores_best"], strict=True)
        told += ", search stages " + " ".join(f"{nearest:.2f}" for nearest in run["after_search_stages"])
        told += ", truth's score against the best " + " ".join(f"{truth:.2f}/{best:.2f}" for truth, best in pairs)
    if "truth_reason" in run:
        scores = f"score {run['truth_score']:.3f} against {run['chosen_score']:.3f}"
        told += f", from the truth: {run['truth_verdict']} ({run['truth_reason']}), {scores}"
    return told


def tables(runs: Sequence[Run]) -> str:
    """Markdown: counts of right and accepted poses, then every run."""
    ordered = sorted(runs, key=lambda run: tuple(str(run[name]) for name in _GROUP))
    groups = [(key, list(part)) for key, part in groupby(ordered, key=lambda run: tuple(run[name] for name in _GROUP))]
    lines = [
        "| halves | map | observation | object | shown in the map | pose right | right within the drift "
        "| accepted and right | accepted and right within the drift | registered and wrong beyond the drift "
        "| median seconds |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [f"| {' | '.join(key)} | {_counts(part)} |" for key, part in groups]
    for key, part in groups:
        lines += ["", f"{', '.join(key)}:", "", *_each(part)]
    return "\n".join(lines) + "\n"


def _counts(runs: Sequence[Run]) -> str:
    """Of the things that the map shows; wrong ones of all."""
    seconds = sorted(run["seconds"] for run in runs)[len(runs) // 2]
    shown = [run for run in runs if run["shown"]]
    return " | ".join(
        str(value)
        for value in (
            f"{len(shown)} of {len(runs)}",
            sum(run["right"] for run in shown),
            sum(run["right_within_drift"] for run in shown),
            sum(run["right"] and run["accepted"] for run in shown),
            sum(run["right_within_drift"] and run["accepted"] for run in shown),
            sum(not run["right_within_drift"] and run["verdict"] == "registered" for run in runs),
            f"{seconds:.1f}",
        )
    )


def _each(runs: Sequence[Run]) -> list[str]:
    lines = [
        "| thing | seed | verdict | errors | seen in the map | drift, mm | lost by |",
        "|---|---|---|---|---|---|---|",
    ]
    for run in runs:
        lines.append(
            f"| {run['group']} | {run['seed']} | {run['verdict']} ({run['reason']}) | {errors(run)} "
            f"| {100.0 * run['seen_share']:.0f} % | {1000.0 * run['drift_m']:.1f} | {run.get('lost_by', '')} |"
        )
    return lines
