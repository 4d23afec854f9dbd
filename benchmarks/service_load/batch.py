"""Many pairs in one batch over HTTP, while workers are killed: pairs a minute, processor time a pair, and what is lost.

    python -m benchmarks.service_load.batch [--pairs 1000] [--workers 2] [--kill-every 60] [--pictures] [--output ...]

The pairs are the small fields with seeds of their own. Every so many seconds one worker is killed and another started
in its place. Each pair has to have one result: what has none is lost. Processor time is that of all processes of the
service, those that were killed included: it says on a busy machine too what a pair costs.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from benchmarks.service_load.house import House, standing_house
from benchmarks.service_load.report import headed, load, write
from benchmarks.service_load.small_fields import write_small_pair
from regnf_client import Client
from regnf_state.redis.client import connect
from tests.processes import processor_seconds

_OPTIONS = {"up_axis": "z"}
_NDJSON = {"Content-Type": "application/x-ndjson"}
_PATIENCE_S = 600.0


@dataclass(frozen=True)
class Run:
    """One batch: seconds from its post to its last result, the lines, and the processor seconds of its parts."""

    seconds: float
    lines: list[dict[str, Any]]
    processor: dict[str, float]
    kills: int

    @property
    def engine(self) -> list[float]:
        """The engine's own seconds of each pair."""
        return [line["metrics"]["seconds"] for line in self.lines if line["status"] == "successful"]


class Killer(threading.Thread):
    """Kills one worker after the other, every ``every_s`` seconds."""

    def __init__(self, house: House, every_s: float) -> None:
        super().__init__(daemon=True)
        self._house = house
        self._every_s = every_s
        self.ended = threading.Event()
        self.kills = 0
        self.spent = 0.0
        """Processor seconds of those that were killed."""

    def run(self) -> None:
        while not self.ended.wait(self._every_s):
            index = self.kills % len(self._house.workers)
            self.spent += processor_seconds(self._house.workers[index].pid)
            self._house.kill_worker(index)
            self.kills += 1


def spent_by(house: House) -> dict[str, float]:
    """Processor seconds of the parts of the service so far."""
    assert house.api is not None
    with connect(house.redis.url) as redis:
        told: Any = redis.info("cpu")
    return {
        "front end": processor_seconds(house.api.pid),
        "workers and their jobs": sum(processor_seconds(worker.pid) for worker in house.workers),
        "Redis": told["used_cpu_sys"] + told["used_cpu_user"],
    }


def results(client: httpx.Client, batch_id: str) -> Iterator[dict[str, Any]]:
    """The results as they come."""
    after = 0
    while True:
        answer = client.get(f"/batches/{batch_id}/results", params={"after": after, "wait": 20})
        lines = [json.loads(line) for line in answer.text.splitlines()]
        yield from lines
        after = int(answer.headers["batch-after"])
        if answer.headers["batch-left"] == "0":
            return


def measure(folder: Path, pairs: int, workers: int, kill_every_s: float, pictures: bool, **settings: object) -> Run:
    pair = write_small_pair(folder)
    with standing_house(folder, threads=1, lost_after_s=15, **settings) as house:
        house.patience_s = _PATIENCE_S
        house.start(workers)
        with Client(house.address) as remote:
            request = {**pair.upload(remote), "options": _OPTIONS, "pictures": pictures}
        with httpx.Client(base_url=house.address, timeout=60) as client:
            client.post("/register", json={**request, "seed": 2**31}, headers={"Prefer": "wait=30"})  # makes the model
            body = "\n".join(json.dumps({**request, "seed": seed, "key": str(seed)}) for seed in range(pairs))
            killer, before, begun = Killer(house, kill_every_s), spent_by(house), time.monotonic()
            killer.start()
            batch = client.post("/batches", content=body, headers=_NDJSON).json()
            lines = list(results(client, batch["id"]))
            seconds = time.monotonic() - begun
            killer.ended.set()
            killer.join()
            after = spent_by(house)
    processor = {name: after[name] - before[name] for name in after}
    processor["workers and their jobs"] += killer.spent
    return Run(seconds, lines, processor, killer.kills)


def table(run: Run, pairs: int, workers: int) -> list[str]:
    ended = Counter(line["key"] for line in run.lines)
    lost = sum(ended[str(seed)] == 0 for seed in range(pairs))
    twice = sum(count > 1 for count in ended.values())
    outcomes = Counter(line.get("verdict") or line["error"]["reason"] for line in run.lines)
    engine = sum(run.engine) / max(1, len(run.engine))
    whole = sum(run.processor.values()) / pairs
    rows = [
        ("pairs, workers, workers killed", f"{pairs}, {workers}, {run.kills}"),
        ("lost, told twice", f"{lost}, {twice}"),
        ("how they ended", ", ".join(f"{count} {name}" for name, count in outcomes.most_common())),
        ("pairs a minute", f"{60 * pairs / run.seconds:.0f}"),
        ("processor seconds a pair", f"{whole:.2f}"),
        ("pairs a minute and core, were the cores free", f"{60 / whole:.0f}"),
        *((f"of these, {name}", f"{value / pairs:.3f}") for name, value in run.processor.items()),
        ("engine's own seconds a pair, mean and median", f"{engine:.2f}, {statistics.median(run.engine):.2f}"),
    ]
    return ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kill-every", type=float, default=60.0)
    parser.add_argument("--pictures", action="store_true", help="of each pair, too")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    before = load()
    with tempfile.TemporaryDirectory(prefix="regnf-") as name:
        asked_for = (arguments.pairs, arguments.workers, arguments.kill_every, arguments.pictures)
        run = measure(Path(name), *asked_for, preload=True)
    asked = f"--pairs {arguments.pairs} --workers {arguments.workers} --kill-every {arguments.kill_every:.0f}"
    asked += " --pictures" if arguments.pictures else ""
    text = headed(
        f"python -m benchmarks.service_load.batch {asked}",
        [before, load()],
        table(run, arguments.pairs, arguments.workers),
    )
    write("A batch over HTTP", text, arguments.output)


if __name__ == "__main__":
    main()
