"""Every method on every pair, as one table."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version

from benchmarks.peers.judging import DEFINITION, NO_POSE, RIGHT, SKIPPED, WRONG
from benchmarks.robust.report import Section, Table, by_group, count, median
from benchmarks.robust.runs import Run

_PACKAGES = ("open3d-cpu", "open3d", "kiss-matcher", "small_gicp", "splatreg", "numpy", "scipy")
_SUMMARY = (
    "method",
    "given beside points and box",
    "within 2 %",
    "5 %",
    "10 %",
    "wrong poses",
    "no pose",
    "MSSD % median",
    "worst",
    "rotation rad",
    "translation %",
    "scale %",
    "evaluations (1000)",
    "seconds",
)


def table(name: str, runs: Sequence[Run], notes: Sequence[str]) -> Table:
    """The summary, then the paper's own metrics by pair; everything but successes is listed."""
    done = [run for run in runs if run["category"] != SKIPPED]
    skipped = {run["group"]: run["reason"] for run in runs if run["category"] == SKIPPED}
    left_out = [f"{method} is skipped: {reason}." for method, reason in skipped.items()]
    return Table(
        name,
        "regnf and its peers",
        [],
        [
            Section(
                "All pairs and seeds. MSSD, translation and scale errors are shares of the diameter and the true "
                "scale; the rotation error is an angle, least over the symmetries; medians and the worst are over the "
                "runs that gave a pose. Evaluations and seconds include the sampling of the surface points.",
                _SUMMARY,
                [summary_row(method, some) for method, some in by_group(done).items()],
            ),
            Section(
                "The paper's metrics, means over the seeds that gave a pose: translation RMSE (object units) / RMSE of "
                "the Euler angles (radians) / |s - true s|. They know no symmetry: a table turned by its own symmetry "
                "counts as wrong here.",
                ("pair", *by_group(done)),
                [paper_row(case, some, list(by_group(done))) for case, some in by_group(done, "case").items()],
            ),
        ],
        runs,
        [run for run in runs if run["category"] in (WRONG, NO_POSE)],
        DEFINITION,
        [*left_out, *notes, f"Versions: {', '.join(versions())}."],
    )


def summary_row(method: str, runs: Sequence[Run]) -> list[str]:
    """A row under the summary's head."""
    shares = [run["mssd_share"] for run in runs if "mssd_share" in run]
    within = [f"{sum(share <= limit for share in shares)}/{len(runs)}" for limit in (0.02, 0.05, 0.10)]
    return [
        method,
        runs[0].get("given", ""),
        *within,
        str(count(runs, WRONG)),
        str(count(runs, NO_POSE)),
        f"{100 * median(runs, 'mssd_share'):.3f}",
        f"{100 * max(shares, default=float('nan')):.3f}",
        f"{median(runs, 'rotation_error_rad'):.4f}",
        f"{100 * median(runs, 'translation_error_share'):.3f}",
        f"{100 * median(runs, 'scale_error_share'):.3f}",
        f"{median(runs, 'field_evaluations') / 1000:.0f}",
        f"{median(runs, 'seconds'):.1f}",
    ]


def paper_row(case: str, runs: Sequence[Run], methods: Sequence[str]) -> list[str]:
    """One pair's errors by method, in the paper's metrics."""
    cells = []
    for method in methods:
        some = [run for run in runs if run["group"] == method and run["category"] in (RIGHT, WRONG)]
        means = [_mean(run[key] for run in some) for key in ("translation_rmse", "euler_rmse_rad", "scale_error")]
        cells.append(" / ".join(f"{mean:.3f}" for mean in means) if some else "none")
    return [case, *cells]


def versions() -> list[str]:
    """Name and version of what did the work, as far as it is installed."""
    found = [f"Python {platform.python_version()}"]
    for package in _PACKAGES:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return found


def _mean(values: Iterable[float]) -> float:
    listed = list(values)
    return sum(listed) / len(listed) if listed else float("nan")
