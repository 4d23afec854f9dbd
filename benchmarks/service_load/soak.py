"""A thousand jobs while workers, jobs' processes and Redis are killed at random: all have to end as they should.

    python -m benchmarks.service_load.soak [--jobs 1000] [--seed 1] [--output benchmarks/results/service_soak.md]

Two workers that load the engine beforehand (REGNF_PRELOAD); eight clients, each of which posts a job, waits for its
end, compares its result with that of the same question asked in peace, and goes on. Of ten jobs four are small
registrations, five fail for want of a surface, one is cancelled. Meanwhile, every few seconds: a worker is killed, or
the process of a job, or Redis is killed and started again, or emptied. Jobs are forgotten two minutes after their end,
so that memory has to stay as it is. Ends with status 1 when a job ends otherwise, memory grows, or files are left.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from redis.exceptions import RedisError

from benchmarks.service_load.clients import Client, Expected
from benchmarks.service_load.house import House, running_house
from benchmarks.service_load.report import headed, load, write
from benchmarks.service_load.small_fields import write_small_pair
from regnf_state.redis.client import connect

_SAMPLE_S = 5.0
_MOST_GROWTH = 0.05
_SETTINGS: dict[str, object] = {
    "threads": 1,
    "heartbeat_s": 1.0,
    "lost_after_s": 10.0,
    "job_retention_s": 120,
    "preload": True,
}


@dataclass(frozen=True)
class Plan:
    """What to run. ``actions`` weighs what is done to the service, ``pauses_s`` bounds the time between two of them."""

    jobs: int
    seed: int
    clients: int = 8
    workers: int = 2
    questions: int = 6
    actions: tuple[tuple[str, int], ...] = (("worker", 4), ("job", 4), ("redis", 2), ("emptied", 1))
    pauses_s: tuple[float, float] = (4.0, 16.0)
    max_actions: int = 1_000_000


@dataclass
class Samples:
    """What was seen while the jobs ran: bytes of the API and of Redis, the machine's load."""

    api: list[int] = field(default_factory=list)
    redis: list[int] = field(default_factory=list)
    loads: list[float] = field(default_factory=lambda: [load()])

    def growth(self, values: list[int]) -> float:
        """By how much the last fifth's median exceeds that of the second, a share: the first fifth is the start."""
        fifth = max(1, len(values) // 5)
        return statistics.median(values[-fifth:]) / statistics.median(values[fifth : 2 * fifth]) - 1.0


def disturb(house: House, plan: Plan, stop: threading.Event, done: Counter[str]) -> None:
    """Kill something every few seconds."""
    random, (names, weights) = Random(plan.seed), zip(*plan.actions, strict=True)
    while done.total() < plan.max_actions and not stop.wait(random.uniform(*plan.pauses_s)):
        what = random.choices(names, weights)[0]
        worker = random.randrange(len(house.workers))
        if what == "worker":
            house.kill_worker(worker)
        elif what == "job" and not house.kill_job(worker):
            continue
        elif what == "redis":
            house.redis.kill()
            stop.wait(random.uniform(0.0, 4.0))
            house.redis.start()
        elif what == "emptied":
            house.empty_redis()
        done[what] += 1


def watch(house: House, stop: threading.Event, samples: Samples) -> None:
    """Take the samples; Redis has none while it is away."""
    with connect(house.redis.url, retries=0) as client:
        while not stop.wait(_SAMPLE_S):
            samples.api.append(house.api_memory())
            samples.loads.append(load())
            try:
                samples.redis.append(house.redis_memory(client))
            except RedisError:
                continue


@dataclass
class Run:
    """How a soak went."""

    plan: Plan
    seconds: float
    outcomes: Counter[str]
    troubles: Counter[str]
    """What clients met on the way and had to come back for, by reason."""
    done: Counter[str]
    samples: Samples
    faults: list[str]


def soak(folder: Path, plan: Plan) -> Run:
    """The whole run."""
    pair = write_small_pair(folder)
    outcomes, troubles, done, samples, stop = (
        Counter[str](),
        Counter[str](),
        Counter[str](),
        Samples(),
        threading.Event(),
    )
    with running_house(folder, plan.workers, **_SETTINGS) as house:
        expected = Expected.of(house.address, pair, plan.questions)
        threads = [
            threading.Thread(target=disturb, args=(house, plan, stop, done)),
            threading.Thread(target=watch, args=(house, stop, samples)),
        ]
        begun = time.monotonic()
        for thread in threads:
            thread.start()
        try:
            with (
                Client(house.address, expected, outcomes, troubles) as client,
                ThreadPoolExecutor(plan.clients) as pool,
            ):
                faults = list(filter(None, pool.map(client.run, range(plan.jobs))))
        finally:
            stop.set()
            for thread in threads:
                thread.join()
        seconds = time.monotonic() - begun
        left = house.left_behind()
    faults += [f"left behind: {name}" for name in left]
    return Run(plan, seconds, outcomes, troubles, done, samples, faults)


def judged(run: Run) -> list[str]:
    """The faults, those of memory included."""
    grown = {"the API": run.samples.api, "Redis": run.samples.redis}
    return run.faults + [
        f"{name} has grown by {run.samples.growth(values):.1%}"
        for name, values in grown.items()
        if len(values) >= 10 and run.samples.growth(values) > _MOST_GROWTH
    ]


def table(run: Run, faults: list[str]) -> list[str]:
    api, redis = run.samples.api, run.samples.redis
    return [
        f"{run.plan.jobs} jobs in {run.seconds / 60:.0f} minutes, {run.plan.workers} workers of one thread, "
        f"{run.plan.clients} clients. "
        + ("All ended as they should; nothing was left behind." if not faults else f"{len(faults)} faults:"),
        *[f"- {fault}" for fault in faults[:20]],
        "",
        "| how jobs ended | count |",
        "|---|---|",
        *[f"| {name} | {count} |" for name, count in sorted(run.outcomes.items())],
        "",
        "| what was done to it | times |",
        "|---|---|",
        *[f"| {name} | {count} |" for name, count in sorted(run.done.items())],
        "",
        "| what clients had to repeat for | times |",
        "|---|---|",
        *[f"| {name} | {count} |" for name, count in sorted(run.troubles.items())],
        "",
        f"API: {min(api) / 1e6:.1f} to {max(api) / 1e6:.1f} MB, the last fifth {run.samples.growth(api):+.1%} over the "
        f"second. Redis: {min(redis) / 1e6:.2f} to {max(redis) / 1e6:.2f} MB, {run.samples.growth(redis):+.1%}.",
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="regnf-soak-") as name:
        run = soak(Path(name), Plan(arguments.jobs, arguments.seed))
    faults = judged(run)
    command = f"python -m benchmarks.service_load.soak --jobs {arguments.jobs} --seed {arguments.seed}"
    write("A soak", headed(command, run.samples.loads, table(run, faults)), arguments.output)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
