"""Jobs with options at the ends of their ranges: refused, or within the memory of one job.

    python -m benchmarks.option_extremes --minutes 20 [--report]

Every option alone at both ends, every pair, and all together, for both presets (tests/option_extremes.py); of those
with the same estimated cost, two. What is not refused by it runs in a process under the limits of a job. Rays meet a
box that fills its detection box: most of them find surface, which is the most memory that rays can take. The preset
`robust` meets foam, which has surface in every cell: no object gives more samples. A run is ended after --seconds: the
job's own time limit ends it as well. Dear ones first; --minutes bounds the whole.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from regnf_core.cost import MIB, Cost, estimate
from regnf_core.errors import RegnfError
from regnf_core.geometry.box import OrientedBox
from regnf_core.library import register
from regnf_core.options import RegistrationOptions
from regnf_core.viewing.artifacts import write_artifacts
from regnf_worker import kernel
from regnf_worker.job_limits import JobLimits
from tests.core.analytic import AnalyticField, boxes
from tests.option_extremes import extremes

RESULTS = Path(__file__).parent / "results" / "option_extremes.md"
LIMIT = JobLimits(4096 * MIB, 4096 * MIB)
SECONDS_LIMIT = 900.0
_OF_EACH_COST = 2
_WAVES = 90.0
DETECTION = OrientedBox.from_corners([-0.3, -0.25, -0.2], [0.3, 0.25, 0.2])


@dataclass(frozen=True)
class Run:
    """How one set of options fared. peak: resident bytes."""

    name: str
    preset: str
    cost: Cost
    outcome: str
    peak: int = 0


def fields(preset: str) -> tuple[AnalyticField, AnalyticField]:
    """A scene and an object, the same shape: a box that fills the detection box, or foam with surface everywhere."""
    bounds = [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]
    if preset == "robust":
        return AnalyticField(_foam, bounds), AnalyticField(_foam, bounds)
    half = [0.29, 0.24, 0.19]
    block = [([-one for one in half], half)]
    return boxes(block, bounds=bounds), boxes(block, bounds=bounds)


def _foam(points: Tensor) -> Tensor:
    """A gyroid with walls a few hundredths apart."""
    s, c = (_WAVES * points).sin(), (_WAVES * points).cos()
    value: Tensor = (s * c.roll(-1, -1)).sum(-1) / _WAVES
    return value


def run(name: str, values: dict[str, Any], seconds: float) -> Run:
    """Run it, or say that it is refused."""
    options = RegistrationOptions.from_dict(values)
    cost = estimate(options)
    if is_refused(cost):
        return Run(name, options.preset, cost, "refused")
    outcome, peak = in_child(options, seconds)
    return Run(name, options.preset, cost, outcome, peak)


def in_child(options: RegistrationOptions, seconds: float) -> tuple[str, int]:
    """Register in a process under a job's limits: how it ended, and its peak of resident memory."""
    with tempfile.TemporaryDirectory() as folder:
        child = kernel.forked(lambda: os._exit(_job(options, Path(folder))))
        deadline = time.monotonic() + seconds
        while True:
            pid, status, usage = os.wait4(child, os.WNOHANG)
            if pid:
                break
            if time.monotonic() > deadline:
                os.kill(child, signal.SIGKILL)
                _, _, usage = os.wait4(child, 0)
                return f"within its limits for {seconds:.0f} s, then ended", usage.ru_maxrss * 1024
            time.sleep(0.02)
    words = {0: "ended well", 1: "an error of its own", 2: "OUT OF MEMORY"}
    return words.get(os.waitstatus_to_exitcode(status), f"CRASHED ({status})"), usage.ru_maxrss * 1024


def _job(options: RegistrationOptions, folder: Path) -> int:
    LIMIT.hold_here()
    torch.set_num_threads(1)
    try:
        write_artifacts(register(*fields(options.preset), DETECTION, options), folder)
    except RegnfError:
        return 1
    except (MemoryError, RuntimeError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def dearest_first() -> list[tuple[str, dict[str, Any]]]:
    """Both presets' extremes, two of each estimated cost, by their memory; what is refused comes last."""
    found: dict[Cost, list[tuple[str, dict[str, Any]]]] = {}
    for entry in (*limits_of_rays(), *extremes("paper"), *extremes("robust")):
        found.setdefault(estimate(RegistrationOptions.from_dict(entry[1])), []).append(entry)
    costs = sorted(found, key=lambda cost: (is_refused(cost), -cost.memory_bytes))
    return [entry for cost in costs for entry in found[cost][:_OF_EACH_COST]]


def is_refused(cost: Cost) -> bool:
    return cost.memory_bytes > LIMIT.memory or cost.seconds > SECONDS_LIMIT


def limits_of_rays() -> Iterator[tuple[str, dict[str, Any]]]:
    """The most rays that are accepted, in three ways."""
    for views, size, stride in ((64, 3072, 16), (9, 512, 1), (2, 1024, 1)):
        sampling = {"views": views, "image_size": size, "pixel_stride": stride}
        short = {"optimization": {"iterations": 2}}
        yield f"{views} views, {size} px, stride {stride}", {"preset": "paper", "sampling": sampling, **short}
        fine = short | {"initialization": {"voxel_size": 0.0015, "ransac_iterations": 1000}}
        yield f"the same, voxels of 0.0015 ({views} views)", {"preset": "paper", "sampling": sampling, **fine}


def report(runs: list[Run], left: int) -> str:
    ran = sorted((one for one in runs if one.outcome != "refused"), key=lambda one: -one.peak)
    bad = [one for one in ran if one.outcome.startswith(("OUT", "CRASHED"))]
    lines = [
        "# Options at the ends of their ranges",
        "",
        "    python -m benchmarks.option_extremes --report",
        "",
        f"{len(runs)} sets of options: {len(runs) - len(ran)} refused by their estimated cost, {len(ran)} run under a"
        f" limit of 4 GiB, {len(bad)} of them out of memory or crashed; {left} not tried for want of time, all of them",
        "estimated at less memory than those that ran.",
        "",
        "The largest peaks:",
        "",
        "| preset | options | estimated, MiB | peak, MiB | outcome |",
        "|---|---|---|---|---|",
    ]
    for one in [*bad, *ran[:15]]:
        estimated = one.cost.memory_bytes // MIB
        lines.append(f"| `{one.preset}` | {one.name} | {estimated:,} | {one.peak // MIB:,} | {one.outcome} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--seconds", type=float, default=60.0, help="longest time of one run")
    parser.add_argument("--report", action="store_true", help=f"write {RESULTS.name}")
    asked = parser.parse_args()
    end, runs, entries = time.monotonic() + 60.0 * asked.minutes, [], dearest_first()
    for name, values in entries:
        cost = estimate(RegistrationOptions.from_dict(values))
        refused = is_refused(cost)
        if refused or time.monotonic() < end:
            runs.append(run(name, values, asked.seconds))
            if not refused:
                print(f"{runs[-1].peak // MIB:6,} MiB  {runs[-1].outcome}  {name}", flush=True)
    text = report(runs, len(entries) - len(runs))
    print(text)
    if asked.report:
        RESULTS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
