"""Two thousand slow connections beside two hundred pollers and somebody who uploads two fields and registers them.

    python -m benchmarks.service_load.slow_clients [--slow 2000] [--seconds 60]
        [--output benchmarks/results/service_slow_clients.md]

The slow ones come from a process of their own (`slow_connections`), all from one address, which the pollers and the
honest client share; they have a token of another caller. Each poller asks for a job every two seconds. One worker, one
thread.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.service_load.connection import Connection
from benchmarks.service_load.house import House, running_house
from benchmarks.service_load.report import headed, load, write
from benchmarks.service_load.small_fields import SmallPair, submit, write_small_pair
from regnf_client import Client

_POLLERS = 200
_EVERY_S = 2.0
_CALM_S = 12.0
_PATIENCE_S = 5.0
_OPTIONS = {"up_axis": "z"}
_HONEST, _SLOW = "honest-caller-of-the-benchmark", "slow-caller-of-the-benchmark"
_TOKENS = f'["honest:{_HONEST}", "slow:{_SLOW}"]'


@dataclass
class Seen:
    """polls: (moment, seconds until the answer); moments are of the monotonic clock · lost: polls without an answer."""

    polls: list[tuple[float, float]] = field(default_factory=list)
    lost: list[float] = field(default_factory=list)
    honest: str = "did not end"
    slow: dict[str, int] = field(default_factory=dict)
    loads: list[float] = field(default_factory=lambda: [load()])
    log_bytes: int = 0


async def poll(port: int, path: str, until: float, seen: Seen) -> None:
    """One poller. A connection that breaks, or says nothing for five seconds, is a lost poll; the next is made anew."""
    await asyncio.sleep(random.uniform(0.0, _EVERY_S))
    while time.monotonic() < until:
        try:
            async with asyncio.timeout(_PATIENCE_S):
                connection = await Connection(port, _HONEST).__aenter__()
            async with connection:
                await _poll_on(connection, path, until, seen)
        except (OSError, TimeoutError, asyncio.IncompleteReadError):
            seen.lost.append(time.monotonic())
            await asyncio.sleep(_EVERY_S)


async def _poll_on(connection: Connection, path: str, until: float, seen: Seen) -> None:
    while time.monotonic() < until:
        begun = time.monotonic()
        async with asyncio.timeout(_PATIENCE_S):
            status, _ = await connection.get(path)
        if status == 200:
            seen.polls.append((begun, time.monotonic() - begun))
        else:
            seen.lost.append(begun)
        await asyncio.sleep(max(0.0, begun + _EVERY_S - time.monotonic()))


def be_honest(house: House, pair: SmallPair, begin: float, seen: Seen) -> None:
    """Upload two fields and register them, while the others do what they do."""
    time.sleep(max(0.0, begin - time.monotonic()))
    begun = time.monotonic()
    try:
        with Client(house.address, _HONEST) as remote:
            request = {**pair.upload(remote), "options": _OPTIONS, "seed": 4711}
            job_id = submit(remote, request)
            remote.wait(job_id)
            verdict = remote.result(job_id).verdict
        seen.honest = f"{verdict} after {time.monotonic() - begun:.1f} s"
    except Exception as error:  # noqa: BLE001 -- whatever it was, it is the result
        seen.honest = f"failed after {time.monotonic() - begun:.1f} s: {type(error).__name__}: {error}"


async def everybody(port: int, path: str, until: float, seen: Seen) -> None:
    async with asyncio.TaskGroup() as group:
        for _ in range(_POLLERS):
            group.create_task(poll(port, path, until, seen))
        while time.monotonic() < until:
            await asyncio.sleep(2.0)
            seen.loads.append(load())


def measure(folder: Path, slow: int, seconds: float) -> tuple[Seen, float]:
    """What was seen, and when the slow connections began."""
    with running_house(folder, 1, _HONEST, threads=1, api_tokens=_TOKENS, quota_calls_per_s=0) as house:
        seen, port = Seen(), house.listener.getsockname()[1]
        with Client(house.address, _HONEST) as remote:
            request = {**write_small_pair(folder).upload(remote), "options": _OPTIONS}
            path = f"/jobs/{submit(remote, request)}"
        begin = time.monotonic() + _CALM_S
        until = begin + seconds
        honest = threading.Thread(
            target=be_honest, args=(house, write_small_pair(folder / "new", 1.0001), begin + 22.0, seen), daemon=True
        )
        honest.start()
        pollers = threading.Thread(target=lambda: asyncio.run(everybody(port, path, until, seen)))
        pollers.start()
        time.sleep(max(0.0, begin - time.monotonic()))
        command = [
            sys.executable,
            "-m",
            "benchmarks.service_load.slow_connections",
            str(port),
            str(slow),
            str(seconds),
            _SLOW,
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        seen.slow = json.loads(done.stdout)
        pollers.join()
        honest.join(timeout=30.0)
        seen.log_bytes = (folder / "api.log").stat().st_size
    return seen, begin


def table(seen: Seen, begin: float, slow: int) -> list[str]:
    lines = [
        f"{slow} slow connections, {_POLLERS} pollers. The honest client's upload and registration: {seen.honest}.",
        "",
        "| | answered | lost | p50 ms | p99 ms | max ms |",
        "|---|---|---|---|---|---|",
    ]
    for name, during in (("polls before", False), ("polls beside the slow connections", True)):
        times = np.array([taken * 1000 for moment, taken in seen.polls if (moment >= begin) == during] or [np.nan])
        lost = sum((moment >= begin) == during for moment in seen.lost)
        p50, p99 = np.percentile(times, [50, 99])
        lines.append(f"| {name} | {np.isfinite(times).sum()} | {lost} | {p50:.1f} | {p99:.1f} | {times.max():.0f} |")
    told = ", ".join(f"{count} {what}" for what, count in sorted(seen.slow.items()))
    return [*lines, "", f"Slow connections: {told}. The API's log: {seen.log_bytes / 1e3:.0f} kB."]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--slow", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="regnf-") as folder:
        seen, begin = measure(Path(folder), arguments.slow, arguments.seconds)
    command = f"python -m benchmarks.service_load.slow_clients --slow {arguments.slow} --seconds {arguments.seconds:g}"
    write("Slow clients", headed(command, seen.loads, table(seen, begin, arguments.slow)), arguments.output)


if __name__ == "__main__":
    main()
