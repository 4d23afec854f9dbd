"""Running many cases: one plain dictionary a run, whatever the table makes of it."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.robust.cases import Case
from benchmarks.robust.judging import judge, judge_error
from regnf_core import RegistrationOptions, RegistrationResult, RegnfError, register
from regnf_core.version import ENGINE_REVISION

Run = dict[str, Any]
ROBUST = RegistrationOptions(preset="robust")


@dataclass(frozen=True, eq=False)
class Job:
    """A case, made when its turn comes, and the seed to run it with; ``group`` is what it is counted under."""

    make: Callable[[], Case]
    group: str
    seed: int = 0
    options: RegistrationOptions = ROBUST


@dataclass(frozen=True)
class Context:
    """What every table is given: the folder of fields, how many seeds, and at most how many runs (None: all)."""

    folder: Path
    seeds: int = 10
    limit: int | None = None
    show: Callable[[str], None] = lambda line: None


def run_all(
    jobs: Sequence[Job],
    context: Context,
    measure: Callable[[Case, RegistrationResult], dict[str, Any]] | None = None,
) -> list[Run]:
    """Every job's run, in order. With a limit, that many of the jobs, drawn at random, the same ones each time."""
    if context.limit is not None and len(jobs) > context.limit:
        jobs = [jobs[i] for i in sorted(random.Random(0).sample(range(len(jobs)), context.limit))]
    runs = []
    for number, job in enumerate(jobs):
        runs.append(run_one(job, measure))
        context.show(f"{number + 1}/{len(jobs)} {summary(runs[-1])}")
    return runs


def run_one(job: Job, measure: Callable[[Case, RegistrationResult], dict[str, Any]] | None = None) -> Run:
    """One registration. What ``measure`` finds is added."""
    case = job.make()
    begun = time.perf_counter()
    found: Run
    try:
        result = register(case.scene, case.obj, case.detection, job.options, job.seed, clouds=False)
    except RegnfError as error:
        found = {"seconds": time.perf_counter() - begun, **judge_error(error)}
    else:
        found = {"seconds": time.perf_counter() - begun, **judge(result, case.truth, case.symmetries)}
        found |= measure(case, result) if measure is not None else {}
    return {"revision": ENGINE_REVISION, "group": job.group, "case": case.name, "seed": job.seed, **found}


def summary(run: Run) -> str:
    """A line to follow the progress by."""
    mssd = f", MSSD {100 * run['mssd_share']:.3f} %" if "mssd_share" in run else ""
    return (
        f"{run['group']}: {run['case']} seed {run['seed']}: {run['category']} ({run['reason']}){mssd}, "
        f"{run['seconds']:.1f} s"
    )
