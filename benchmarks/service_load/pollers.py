"""Two hundred pollers at once while registrations run and 150 MB are uploaded and imported.

    python -m benchmarks.service_load.pollers [--seconds 45] [--output benchmarks/results/service_pollers.md]

A hundred jobs wait or run. Each is asked for once a second by one, as `Retry-After` tells it to, and by another who
holds a long poll (`?wait=10`) until it has ended. The first are timed by their answers' latency, the others by how long
after a job's end they hear of it. A process of its own uploads the file. One worker, one thread.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.service_load.connection import Connection
from benchmarks.service_load.house import House, running_house
from benchmarks.service_load.report import headed, load, write
from benchmarks.service_load.small_fields import submit, write_small_pair
from regnf_client import Client
from tests.core.importing.checkpoints import write_full_size_checkpoint

_POLLERS = 100
_EVERY_S = 1.0
_LONG_WAIT_S = 10
_OPTIONS = {"up_axis": "z"}
_CALM_S = 15.0
"""How long the pollers poll before the upload begins."""


@dataclass
class Seen:
    """Plain polls: (moment of the request, seconds until its answer); long polls: seconds between a job's end and its
    being known. Moments are of the monotonic clock."""

    plain: list[tuple[float, float]] = field(default_factory=list)
    late: list[float] = field(default_factory=list)
    errors: int = 0
    loads: list[float] = field(default_factory=lambda: [load()])


async def poll(port: int, job_id: str, until: float, seen: Seen) -> None:
    """One plain poller."""
    await asyncio.sleep(random.uniform(0.0, _EVERY_S))
    async with Connection(port) as connection:
        while time.monotonic() < until:
            begun = time.monotonic()
            status, _ = await connection.get(f"/jobs/{job_id}")
            seen.plain.append((begun, time.monotonic() - begun))
            seen.errors += status != 200
            await asyncio.sleep(max(0.0, begun + _EVERY_S - time.monotonic()))


async def hold(port: int, job_id: str, until: float, seen: Seen) -> None:
    """One long poller: asks until its job has ended."""
    job: dict[str, Any] = {"status": "accepted"}
    await asyncio.sleep(random.uniform(0.0, _LONG_WAIT_S))  # clients come when they come, not all at once
    async with Connection(port) as connection:
        while job["status"] in ("accepted", "running") and time.monotonic() < until:
            status, body = await connection.get(f"/jobs/{job_id}?wait={_LONG_WAIT_S}")
            heard = time.time()
            seen.errors += status != 200
            job = json.loads(body)
    if job["status"] == "successful":
        seen.late.append(heard - datetime.fromisoformat(job["finished_at"]).timestamp())


def measure(folder: Path, seconds: float) -> tuple[Seen, tuple[float, float], int, int, bool]:
    """What was seen, when the upload began and ended, its bytes, the API's peak memory, whether the import ended."""
    checkpoint = folder / "full.ckpt"
    write_full_size_checkpoint(checkpoint)
    pair = write_small_pair(folder)
    with running_house(folder, 1, threads=1) as house:
        with Client(house.address) as remote:
            request = {**pair.upload(remote), "options": _OPTIONS}
            jobs = [submit(remote, {**request, "seed": seed}) for seed in range(_POLLERS)]
        until = time.monotonic() + seconds
        moment = str(until - seconds + _CALM_S)
        command = [sys.executable, "-m", "benchmarks.service_load.send", house.address, str(checkpoint), moment]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as sender:
            seen = asyncio.run(_everybody(house, jobs, until))
            begun, end = map(float, sender.communicate(timeout=60)[0].split())
        with httpx.Client(base_url=house.address, timeout=60) as client:
            ended = _eventually_ready(client)
        return seen, (begun, end), checkpoint.stat().st_size, house.api_peak(), ended


def _eventually_ready(client: httpx.Client) -> bool:
    """Whether the upload was imported within three minutes."""
    end = time.monotonic() + 180
    while time.monotonic() < end:
        fields = client.get("/fields").json()["fields"]
        if all(one["state"] == "ready" for one in fields):
            return len(fields) == 3
        time.sleep(0.5)
    return False


async def _everybody(house: House, jobs: list[str], until: float) -> Seen:
    seen, port = Seen(), house.listener.getsockname()[1]
    tasks: list[Callable[[int], Any]] = [
        lambda n: poll(port, jobs[n], until, seen),
        lambda n: hold(port, jobs[n], until, seen),
    ]
    async with asyncio.TaskGroup() as group:
        for number in range(_POLLERS):
            for task in tasks:
                group.create_task(task(number))
        while time.monotonic() < until:
            await asyncio.sleep(2.0)
            seen.loads.append(load())
    return seen


def _row(name: str, seconds: list[float]) -> str:
    if not seconds:
        return f"| {name} | 0 | | | |"
    times = np.array(seconds) * 1000
    p50, p99 = np.percentile(times, [50, 99])
    return f"| {name} | {len(times)} | {p50:.1f} | {p99:.1f} | {times.max():.0f} |"


def table(seen: Seen, sent: tuple[float, float], size: int, peak: int, ended: bool) -> list[str]:
    begun, end = sent
    during = [taken for moment, taken in seen.plain if begun <= moment <= end]
    return [
        f"{_POLLERS} jobs, one after the other, each with a plain and a long poller. Errors: {seen.errors}.",
        "",
        "| | count | p50 ms | p99 ms | max ms |",
        "|---|---|---|---|---|",
        _row("plain polls, all", [taken for _, taken in seen.plain]),
        _row("of these, before the upload", [taken for moment, taken in seen.plain if moment < begun]),
        _row("of these, during the upload", during),
        _row("of these, after it: its import waits and runs", [taken for moment, taken in seen.plain if moment > end]),
        _row("long polls: from a job's end to its being known", seen.late),
        "",
        f"Upload of {size / 1e6:.0f} MB: {end - begun:.1f} s ({size / 1e6 / (end - begun):.0f} MB/s); "
        f"imported: {'yes' if ended else 'no'}. API's peak memory: {peak / 1e6:.0f} MB.",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=45.0)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="regnf-") as folder:
        seen, *rest = measure(Path(folder), arguments.seconds)
    command = f"python -m benchmarks.service_load.pollers --seconds {arguments.seconds:g}"
    write("Two hundred pollers", headed(command, seen.loads, table(seen, *rest)), arguments.output)


if __name__ == "__main__":
    main()
