"""How many registrations two workers do in the time that one does: REGNF_THREADS=1 each, on two cores.

    python -m benchmarks.service_load.workers [--jobs 16] [--rounds 3] [--output benchmarks/results/service_workers.md]

One service. Batches of jobs of the kind benchmarks.service_load.overhead posts are worked off now by one worker, now by
two, in turn, so that whatever else the machine does hits both alike. The time is that from the first job's start to the
last one's end, by the service's own clock.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import tempfile
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx

from benchmarks.service_load.house import running_house
from benchmarks.service_load.report import headed, load, write
from benchmarks.service_load.small_fields import write_small_pair
from regnf_client import Client

_OPTIONS = {"up_axis": "z"}
_WORKERS = (1, 2)


def batch(client: httpx.Client, request: dict[str, Any], seeds: Iterator[int], jobs: int) -> float:
    """Jobs a minute of one batch; posting them takes a moment only."""
    ids = [client.post("/register", json={**request, "seed": next(seeds)}).json()["id"] for _ in range(jobs)]
    ended = []
    for job_id in ids:
        while (job := client.get(f"/jobs/{job_id}", params={"wait": 30}).json())["status"] != "successful":
            if job["status"] in ("failed", "dismissed"):
                raise RuntimeError(f"{job_id}: {job['error']}")
        ended.append(job)
    begun = min(datetime.fromisoformat(job["started_at"]) for job in ended)
    end = max(datetime.fromisoformat(job["finished_at"]) for job in ended)
    return 60 * jobs / (end - begun).total_seconds()


def measure(folder: Path, jobs: int, rounds: int, preload: bool) -> tuple[dict[int, list[float]], list[float]]:
    """Jobs a minute by the number of workers, one figure a round; the machine's load."""
    pair, seeds = write_small_pair(folder), itertools.count()
    rates: dict[int, list[float]] = {count: [] for count in _WORKERS}
    loads = [load()]
    with running_house(folder, 1, threads=1, preload=preload) as house, Client(house.address) as remote:
        request = {**pair.upload(remote), "options": _OPTIONS}
        with httpx.Client(base_url=house.address, timeout=60) as client:
            batch(client, request, seeds, 2)  # the object's model, and files in the page cache
            for _ in range(rounds):
                for count in _WORKERS:
                    house.have_workers(count)
                    rates[count].append(batch(client, request, seeds, jobs))
                    loads.append(load())
    return rates, loads


def table(measured: dict[str, dict[int, list[float]]], jobs: int, rounds: int) -> list[str]:
    lines = [
        f"Registrations a minute, {rounds} batches of {jobs} in turn: median, least and most. The ratio is that of "
        "neighboring batches, its median, least and most.",
        "",
        "| workers load the engine | one worker | two workers | ratio |",
        "|---|---|---|---|",
    ]
    for name, rates in measured.items():
        ratios = [two / one for one, two in zip(rates[1], rates[2], strict=True)]
        cells = [_cell(rates[1], 1), _cell(rates[2], 1), _cell(ratios, 2)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def _cell(values: list[float], digits: int) -> str:
    return f"{statistics.median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    measured, loads = {}, []
    for name, preload in (("for each job", False), ("once (`REGNF_PRELOAD`)", True)):
        with tempfile.TemporaryDirectory(prefix="regnf-") as folder:
            measured[name], seen = measure(Path(folder), arguments.jobs, arguments.rounds, preload)
        loads += seen
    command = f"python -m benchmarks.service_load.workers --jobs {arguments.jobs} --rounds {arguments.rounds}"
    text = headed(command, loads, table(measured, arguments.jobs, arguments.rounds))
    write("Two workers against one", text, arguments.output)


if __name__ == "__main__":
    main()
