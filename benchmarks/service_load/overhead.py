"""What the service adds to a registration: from its POST to its result, less the seconds that the engine took.

    python -m benchmarks.service_load.overhead [--jobs 30] [--before ../older]
                                               [--output benchmarks/results/service_overhead.md]

Two services, one as it is by default and one without REGNF_PRELOAD, or with --before one of an older checkout, as it is
by default. Each has one worker of one thread and the same small fields. Jobs, each with a seed of its own, go to them
in turn, one at a time: the ratio holds on a busy machine too. The engine's seconds are those that the result tells of
(`seconds_*`). Processor seconds are those of all processes of the service, the engine's and the clouds' included.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil

from benchmarks.api_process import api_process
from benchmarks.service_load.report import headed, load, write
from benchmarks.service_load.small_fields import SmallPair, write_small_pair
from regnf_cli.demo import running_service
from regnf_client import Client
from tests.processes import descendants_of, processor_seconds

_OPTIONS = {"up_axis": "z"}
_REST_S = 1.2
_WORKER_S = 600.0
"""A busy machine takes its time to start a worker."""


@dataclass
class Service:
    """One service under measurement. Seconds: what its jobs took beside the engine, and the parts of that."""

    name: str
    client: httpx.Client
    request: dict[str, Any]
    server: int
    """The process that all others of the service descend from."""
    seen: list[float] = field(default_factory=list)
    """From the POST to the answer that has the result, as a client sees it."""
    recorded: list[float] = field(default_factory=list)
    """From the record's making to its end, by the service's own clock."""
    started: list[float] = field(default_factory=list)
    """Until a child has taken the job up."""
    engine: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    """Of all processes of the service, until the clouds are made."""

    def run(self, seed: int) -> None:
        """One job, from its POST to its result."""
        begun, used = time.monotonic(), processor_seconds_below(self.server)
        job = self.client.post("/register", json={**self.request, "seed": seed}).json()
        while job["status"] not in ("successful", "failed"):
            job = self.client.get(f"/jobs/{job['id']}", params={"wait": 30}).json()
        result = self.client.get(f"/jobs/{job['id']}/result").json()
        seconds = time.monotonic() - begun
        while self.client.get(f"/jobs/{job['id']}/artifacts/aligned.ply").status_code == httpx.codes.CONFLICT:
            pass  # held for a while each time, until the clouds are made
        engine = sum(value for name, value in result["metrics"].items() if name.startswith("seconds_"))
        created, started, finished = (
            datetime.fromisoformat(job[f"{at}_at"]) for at in ("created", "started", "finished")
        )
        self.seen.append(seconds - engine)
        self.recorded.append((finished - created).total_seconds() - engine)
        self.started.append((started - created).total_seconds())
        self.engine.append(engine)
        time.sleep(_REST_S)  # until the worker has collected the process
        self.processor.append(processor_seconds_below(self.server) - used)

    def forget_first(self) -> None:
        """The first job makes the object's model for all others."""
        for values in (self.seen, self.recorded, self.started, self.engine, self.processor):
            del values[0]


def processor_seconds_below(process: int) -> float:
    """Processor seconds of a process, its descendants, and those of them that have ended (Linux)."""
    return sum(map(processor_seconds, (process, *descendants_of(process))))


def start(
    stack: ExitStack, name: str, folder: Path, pair: SmallPair, checkout: Path | None = None, **settings: object
) -> Service:
    address = stack.enter_context(running_service(folder, checkout, threads=1, device="cpu", **settings))
    with Client(address, worker_timeout_s=_WORKER_S) as remote:
        request = {**pair.upload(remote), "options": _OPTIONS}
    client = stack.enter_context(httpx.Client(base_url=address, timeout=300))
    for sha256 in (request["scene"], request["object"]):  # their drawing would count as a job's
        while client.get(f"/fields/{sha256}").json().get("views") == "pending":
            time.sleep(1)
    return Service(name, client, request, psutil.Process(api_process(address)).ppid())


def measure(folder: Path, jobs: int, before: Path | None) -> tuple[list[Service], list[float]]:
    pair = write_small_pair(folder)
    loads = [load()]
    with ExitStack() as stack:
        services = [start(stack, "default", folder / "default", pair)]
        if before is None:
            services.append(start(stack, "`REGNF_PRELOAD=false`", folder / "plain", pair, preload=False))
        else:
            services.append(start(stack, "before", folder / "before", pair, before))
        for seed in range(jobs + 1):
            for service in services:
                service.run(seed)
            loads.append(load())
    for service in services:
        service.forget_first()
    return services, loads


def table(services: Sequence[Service], jobs: int) -> list[str]:
    lines = [
        f"{jobs} jobs each, in turn. Seconds beyond the engine's own: median and 95th percentile.",
        "",
        "| service | POST to result | p95 | by its own clock | p95 | until begun | engine | processor seconds |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for service in services:
        cells = [*_middle_and_high(service.seen), *_middle_and_high(service.recorded)]
        cells += [statistics.median(one) for one in (service.started, service.engine, service.processor)]
        lines.append(f"| {service.name} | {' | '.join(f'{cell:.2f}' for cell in cells)} |")
    return lines


def _middle_and_high(values: Sequence[float]) -> tuple[float, float]:
    return statistics.median(values), float(np.percentile(values, 95))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=30)
    parser.add_argument("--before", type=Path, help="an older checkout with its .venv")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="regnf-") as name:
        services, loads = measure(Path(name), arguments.jobs, arguments.before)
    command = f"python -m benchmarks.service_load.overhead --jobs {arguments.jobs}"
    command += " --before OLDER" if arguments.before else ""
    text = headed(command, loads, table(services, arguments.jobs))
    write("What the service adds to a registration", text, arguments.output)


if __name__ == "__main__":
    main()
