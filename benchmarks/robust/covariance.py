"""Table 8: how often the truth lies inside the 95 % ellipsoid of the covariance that comes with a pose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from scipy.stats import binomtest

from benchmarks.robust.bent_field import BentField
from benchmarks.robust.cases import HELD_OUT, MAIN, UNDER_TRAINED, Case, Pair, load_pairs
from benchmarks.robust.ellipsoid import Calibration, calibration, mahalanobis_squared, nearest_truth, pose_error
from benchmarks.robust.judging import SUCCESSES
from benchmarks.robust.report import Bar, Section, Table, by_group, failures_of, median
from benchmarks.robust.runs import Context, Job, Run, run_all
from benchmarks.robust.symmetries import ANY_TURN
from regnf_core import RegistrationResult

NAME = "covariance"
AMPLITUDES = (0.001, 0.003, 0.01)
LENGTHS = (0.05, 0.15, 0.4)
"""Of the bending, object diameters."""
_BENDS_PER_SEED = 0.3


def table(context: Context) -> Table:
    """Clean fields, bent fields and under-trained fits, each group apart."""
    runs = run_all(list(_jobs(context)), context, _measure)
    groups = by_group(runs)
    bars = []
    rows = []
    for name, some in {"all groups together": runs, **groups}.items():
        squares = [run["mahalanobis_squared"] for run in some if run["category"] in SUCCESSES]
        found = calibration(squares)
        bars.append(Bar(f"{name}: 90 to 99 % inside", _share(found), 0.9 <= found.inside <= 0.99))
        rows.append(
            [
                name,
                str(len(some)),
                str(found.count),
                f"{100 * found.inside:.1f}",
                f"{found.median:.2f}",
                f"{found.high:.2f}",
                f"{100 * median(some, 'mssd_share'):.3f}",
            ]
        )
    head = ("group", "runs", "successes", "% inside", "median of d²/7", "95th percentile of d²/7", "MSSD % median")
    text = (
        "d²: Mahalanobis distance squared of the truth, of successful runs alone. Calibrated: median 0.91, 95th "
        "percentile 2.01; larger means that the covariance promises too much. A clean field has one error, the same "
        "for all seeds: a clean group holds as many independent cases as it has pairs."
    )
    return Table(
        NAME,
        "Covariance: the truth and the 95 % ellipsoid",
        bars,
        [Section(text, head, rows)],
        runs,
        failures_of(runs),
        notes=[
            "Bent: a smooth random error (standard deviation and correlation length in object diameters) is added to "
            "both fields, independently and anew for every run. Objects that every turn carries onto themselves are "
            "left out: their turn about the axis has no truth."
        ],
    )


def _jobs(context: Context) -> Iterator[Job]:
    main, held_out = _pairs(context, MAIN), _pairs(context, HELD_OUT)
    for group, pairs in (("clean", main), ("clean, held out", held_out)):
        for pair in pairs:
            for seed in range(context.seeds):
                yield Job(pair.case, group, seed)
    bends = max(1, round(_BENDS_PER_SEED * context.seeds))
    for amplitude in AMPLITUDES:
        for length in LENGTHS:
            for number, pair in enumerate(main):
                for draw in range(bends):
                    yield _bent_job(pair, amplitude, length, draw, 1000 * number + draw)
    for file in UNDER_TRAINED:
        group = (
            file.removeprefix("pairs-").removesuffix(".json").replace("-", " ").replace("percent", "% of the training")
        )
        for pair in _pairs(context, file):
            for seed in range(bends):
                yield Job(pair.case, group, seed)


def _bent_job(pair: Pair, amplitude: float, length: float, seed: int, bend: int) -> Job:
    return Job(partial(bent, pair, amplitude, length, bend), f"bent {100 * amplitude:g} %, length {length:g}", seed)


def bent(pair: Pair, amplitude: float, length: float, bend: int) -> Case:
    """The pair with both fields bent; ``bend`` seeds both, differently. Lengths in object diameters."""
    case, size = pair.case(), pair.diameter
    in_scene = size / float(pair.truth.scale)
    scene = BentField(case.scene, amplitude * in_scene, length * in_scene, 2 * bend)
    obj = BentField(case.obj, amplitude * size, length * size, 2 * bend + 1)
    return replace(case, name=f"{case.name} bend {bend}", scene=scene, obj=obj)


def _share(found: Calibration) -> str:
    """The share inside with its 95 % confidence interval (Clopper and Pearson): small groups say little."""
    if found.count == 0:
        return "no success"
    low, high = binomtest(round(found.inside * found.count), found.count).proportion_ci(0.95)
    return f"{100 * found.inside:.1f} % of {found.count} (95 % interval {100 * low:.0f} to {100 * high:.0f})"


def _pairs(context: Context, file: str) -> Sequence[Pair]:
    return [pair for pair in load_pairs(context.folder, file) if pair.instance not in ANY_TURN]


def _measure(case: Case, result: RegistrationResult) -> dict[str, Any]:
    assert case.truth is not None
    assert result.covariance is not None
    points = result.object_samples.points.double()
    truth = nearest_truth(result.T_object_scene, case.truth, points, case.symmetries)
    error = pose_error(result.T_object_scene, truth)
    found: Run = {"mahalanobis_squared": mahalanobis_squared(error, result.covariance)}
    return {**found, "error": error.tolist(), "spread": result.covariance.diagonal().clamp_min(0).sqrt().tolist()}
