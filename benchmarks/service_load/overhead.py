"""What the service adds to a registration: from its POST to its result, less the seconds that the engine took.

    python -m benchmarks.service_load.overhead [--jobs 30] [--output benchmarks/results/service_overhead.md]

Two services, one as it is by default and one with REGNF_PRELOAD, each with one worker of one thread and the same small
fields. Jobs, each with a seed of its own, go to them in turn, one at a time: the ratio holds on a busy machine too. The
engine's seconds are those that the result tells of (`seconds_*`).
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

from benchmarks.service_load.report import headed, load, quantiles, write
from benchmarks.service_load.small_fields import SmallPair, write_small_pair
from regnf_cli.local_service import running_service
from regnf_cli.remote import RemoteService

_OPTIONS = {"up_axis": "z"}


@dataclass
class Service:
    """One service under measurement. Seconds: what its jobs took beside the engine, and the parts of that."""

    name: str
    client: httpx.Client
    request: dict[str, Any]
    seen: list[float] = field(default_factory=list)
    """From the POST to the answer that has the result, as a client sees it."""
    recorded: list[float] = field(default_factory=list)
    """From the record's making to its end, by the service's own clock."""
    started: list[float] = field(default_factory=list)
    """Until a child has taken the job up."""
    engine: list[float] = field(default_factory=list)

    def run(self, seed: int) -> None:
        """One job, from its POST to its result."""
        begun = time.monotonic()
        job = self.client.post("/register", json={**self.request, "seed": seed}).json()
        while job["status"] not in ("successful", "failed"):
            job = self.client.get(f"/jobs/{job['id']}", params={"wait": 30}).json()
        result = self.client.get(f"/jobs/{job['id']}/result").json()
        seconds = time.monotonic() - begun
        engine = sum(value for name, value in result["metrics"].items() if name.startswith("seconds_"))
        created, started, finished = (
            datetime.fromisoformat(job[f"{at}_at"]) for at in ("created", "started", "finished")
        )
        self.seen.append(seconds - engine)
        self.recorded.append((finished - created).total_seconds() - engine)
        self.started.append((started - created).total_seconds())
        self.engine.append(engine)

    def forget_first(self) -> None:
        """The first job makes the object's model for all others."""
        for values in (self.seen, self.recorded, self.started, self.engine):
            del values[0]


def start(stack: ExitStack, name: str, folder: Path, pair: SmallPair, **settings: object) -> Service:
    address = stack.enter_context(running_service(folder, threads=1, device="cpu", **settings))
    with RemoteService(address) as remote:
        request = {**pair.upload(remote), "options": _OPTIONS}
    return Service(name, stack.enter_context(httpx.Client(base_url=address, timeout=60)), request)


def measure(folder: Path, jobs: int) -> tuple[list[Service], list[float]]:
    pair = write_small_pair(folder)
    loads = [load()]
    with ExitStack() as stack:
        services = [
            start(stack, "default", folder / "default", pair),
            start(stack, "`REGNF_PRELOAD=true`", folder / "preload", pair, preload=True),
        ]
        for seed in range(jobs + 1):
            for service in services:
                service.run(seed)
            loads.append(load())
    for service in services:
        service.forget_first()
    return services, loads


def table(services: Sequence[Service], jobs: int) -> list[str]:
    lines = [
        f"{jobs} jobs each, in turn. Seconds: median, tenth and ninetieth percentile.",
        "",
        "| service | POST to result | p10 | p90 | by its own clock | p10 | p90 | until a child has it | engine |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for service in services:
        started, engine = statistics.median(service.started), statistics.median(service.engine)
        cells = f"{quantiles(service.seen)} | {quantiles(service.recorded)} | {started:.3f} | {engine:.2f}"
        lines.append(f"| {service.name} | {cells} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=30)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="regnf-") as name:
        services, loads = measure(Path(name), arguments.jobs)
    command = f"python -m benchmarks.service_load.overhead --jobs {arguments.jobs}"
    text = headed(command, loads, table(services, arguments.jobs))
    write("What the service adds to a registration", text, arguments.output)


if __name__ == "__main__":
    main()
