"""Tables of runs: how many poses are right, what the verdicts are worth, and after which stage the truth is lost."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from scipy.stats import beta

from benchmarks.random_worlds.walks import LENGTHS
from benchmarks.robust.ellipsoid import calibration
from benchmarks.robust.judging import SUCCESS

Run = dict[str, Any]
_CONFIDENCE = 0.95
NEAR = 0.05
_STAGES = ("searched", "refined")


def lower_bound(hits: int, total: int) -> float:
    """The exact one-sided 95 % bound (Clopper and Pearson) below a rate."""
    return 0.0 if hits == 0 else float(beta.ppf(1.0 - _CONFIDENCE, hits, total - hits + 1))


def upper_bound(hits: int, total: int) -> float:
    """The exact one-sided 95 % bound above a rate."""
    return 1.0 if hits == total else float(beta.ppf(_CONFIDENCE, hits + 1, total - hits))


def pose_right(run: Run) -> bool:
    """Whether the pose is right, whatever the verdict."""
    return bool(run.get("mssd_share", 9.0) <= SUCCESS)


def success(run: Run) -> bool:
    """`registered` and right, or `ambiguous` with the truth among those listed."""
    if run["verdict"] == "ambiguous":
        return bool(run["listed_mssd"] <= SUCCESS)
    return run["verdict"] == "registered" and pose_right(run)


def wrong(run: Run) -> bool:
    """`registered`, and the truth says otherwise."""
    return run["verdict"] == "registered" and not pose_right(run)


def nearly(run: Run) -> bool:
    """Wrong, but right after a turn that nearly carries the object onto itself."""
    return wrong(run) and bool(run["near_mssd"] <= NEAR)


def lost_at(run: Run) -> str:
    """The first stage after which no pose is right any more; `none` for a success."""
    if "searched_mssd" not in run:
        return "before the search"
    if run["searched_mssd"] > SUCCESS and run["refined_mssd"] > SUCCESS:
        return "search"
    if run["refined_mssd"] > SUCCESS:
        return "refinement"
    if not pose_right(run) and run.get("listed_mssd", 9.0) > SUCCESS:
        return "choice"
    return "none" if success(run) else "verdict"


def summary(runs: Sequence[Run]) -> str:
    """A line to follow the progress by."""
    name = runs[0]["world"] if runs else "nothing"
    return f"{name}: {sum(map(success, runs))}/{len(runs)} " + ", ".join(
        f"{run['object']} {run['verdict']} {100 * run.get('mssd_share', float('nan')):.1f} ({lost_at(run)})"
        for run in runs
    )


def markdown(runs: Sequence[Run]) -> str:
    """All tables."""
    keys: list[tuple[str, Callable[[Run], str]]] = [
        ("walk's length", lambda run: run["length"]),
        ("length and kind", lambda run: f"{run['length']} {run['kind']}"),
        ("walk", lambda run: run["walk"].split(",")[0]),
        ("observation", lambda run: "with" if run["observed"] else "without"),
        ("object's field", lambda run: run["field"]),
        ("seen of the object", lambda run: _bin(run["seen"], (0.25, 0.4, 0.6, 0.8))),
        ("voxels across", lambda run: _bin(run["voxels_across"], (15, 25, 40, 80))),
        ("drift, spread over diameter", lambda run: _bin(run["drift_spread"], (0.001, 0.01, 0.02, 0.05))),
        ("sensor", lambda run: run["sensor"]),
        ("pixels", lambda run: run["pixels"]),
        ("symmetry", lambda run: run.get("symmetry", "unknown")),
    ]
    parts = [f"{len(runs)} registrations.", *(_table(name, key, runs) for name, key in keys)]
    parts += [_ellipsoids(runs), _losses(runs)]
    return "\n\n".join(parts) + "\n"


_HEAD = (
    "runs", "success", "at least", "pose right", "registered wrong", "at most", "nearly a symmetry",
    "right but rejected", "searched", "refined", "stable from truth", "MSSD % median", "seconds median", "worst",
)  # fmt: skip


def _table(name: str, key: Callable[[Run], str], runs: Sequence[Run]) -> str:
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    rows = [[group, *_row(some)] for group, some in sorted(groups.items())]
    if len(rows) > 1:
        rows.append(["**all**", *_row(runs)])
    return _cells((name, *_HEAD), rows)


def _row(runs: Sequence[Run]) -> list[str]:
    total, hits, bad = len(runs), sum(map(success, runs)), sum(map(wrong, runs))
    right = [run for run in runs if pose_right(run)]
    staged = [run for run in runs if "searched_mssd" in run]
    stable = [run for run in runs if "truth_mssd" in run]
    seconds = [run["seconds"] for run in runs]
    return [
        str(total),
        _percent(hits, total),
        f"{100 * lower_bound(hits, total):.1f}",
        _percent(len(right), total),
        str(bad),
        f"{100 * upper_bound(bad, total):.2f}",
        str(sum(map(nearly, runs))),
        str(sum(run["verdict"] == "rejected" for run in right)),
        *(_percent(sum(run[f"{stage}_mssd"] <= SUCCESS for run in staged), len(staged)) for stage in _STAGES),
        _percent(sum(run["truth_mssd"] <= SUCCESS for run in stable), len(stable)),
        f"{100 * statistics.median(run['mssd_share'] for run in right):.2f}" if right else "",
        f"{statistics.median(seconds):.1f}",
        f"{max(seconds):.1f}",
    ]


def _ellipsoids(runs: Sequence[Run]) -> str:
    """Whether the true poses lie where the covariances say."""
    told = [run for run in runs if run.get("mahalanobis_squared") is not None]
    groups = {length: [run for run in told if run["length"] == length] for length in LENGTHS}
    rows = []
    for name, some in {**groups, "**all**": told}.items():
        if some:
            found = calibration([run["mahalanobis_squared"] for run in some])
            inside = _percent(round(found.inside * found.count), found.count)
            rows.append([name, inside, f"{found.median:.2f}", f"{found.high:.2f}"])
    head = ("walk's length", "right poses in the 95 % ellipsoid", "median of d²/7", "95th percentile")
    text = "Covariance. d: Mahalanobis distance of the truth; calibrated: .91 and 2.01. Objects of revolution left out."
    return f"{text}\n\n" + _cells(head, rows)


def _losses(runs: Sequence[Run]) -> str:
    """Every run that is no success, by the stage that lost it."""
    lost = sorted((run for run in runs if not success(run)), key=lambda run: (lost_at(run), run["world"]))
    stages = Counter(lost_at(run) for run in lost)
    reasons = Counter(run["reason"] for run in lost if lost_at(run) == "verdict")
    text = "Lost at: " + ", ".join(f"{stage} {count}" for stage, count in stages.most_common())
    text += ". Right poses not accepted for: " + ", ".join(
        f"{reason} {count}" for reason, count in reasons.most_common()
    )
    head = (
        "lost at", "world", "case", "object", "field", "seen", "voxels across", "verdict", "reason", "MSSD %",
        "scale %",
        "seed", "searched", "refined", "from truth", "its score", "chosen score", "its verdict",
    )  # fmt: skip
    return f"{text}.\n\n" + _cells(head, [_loss(run) for run in lost])


def _loss(run: Run) -> list[str]:
    def percent(name: str) -> str:
        return f"{100 * run[name]:.1f}" if name in run else ""

    scores = [f"{run[name]:.3f}" if name in run else "" for name in ("truth_score", "chosen_score")]
    return [
        lost_at(run), run["world"], str(run["case"]), run["object"], run["field"], f"{run['seen']:.2f}",
        f"{run['voxels_across']:.0f}", run["verdict"], run["reason"],
        *(percent(name) for name in ("mssd_share", "scale_error_share")),
        *(percent(f"{stage}_mssd") for stage in ("seed", "searched", "refined", "truth")), *scores,
        f"{run.get('truth_verdict', '')} {run.get('truth_reason', '')}",
    ]  # fmt: skip


def _bin(value: float, edges: Sequence[float]) -> str:
    number = sum(value >= edge for edge in edges)
    low = f"from {edges[number - 1]:g}" if number else "from 0"
    return f"{number} {low}" + (f" to {edges[number]:g}" if number < len(edges) else "")


def _percent(hits: int, total: int) -> str:
    return f"{hits}/{total} ({100 * hits / total:.1f} %)" if total else ""


def _cells(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
