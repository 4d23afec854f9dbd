"""Batches, renderings and imports while every process of the service is killed in turn: what is lost, what is twice.

    python -m benchmarks.service_load.kills [--kills 40] [--every 6] [--pairs 900] [--renders 60] [--imports 60]

Killed are, in turn: the API, a worker, a job's own process, Redis. The clients ask as anybody would who wants to
have everything: a call that fails is made again. In the end every pair, rendering and field must be there, each once,
and no temporary file. Ends with status 1 otherwise. Forty kills take some eight minutes.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from benchmarks.service_load.house import House, standing_house
from benchmarks.service_load.report import headed, load, write
from benchmarks.service_load.small_fields import write_small_pair
from regnf_client import Client, Pair, PairResult
from regnf_core.errors import RegnfError

_Value = TypeVar("_Value")
_WITHIN_S = 900.0
_RENDERING = {"size": [32, 32], "orbit": {"frames": 2}, "outputs": ["color"]}


def insisting(do: Callable[[], _Value], failed: Counter[str]) -> _Value:
    """What ``do`` returns, called again while the service is away or has lost a worker."""
    end = time.monotonic() + _WITHIN_S
    while True:
        try:
            return do()
        except RegnfError as error:
            failed[error.reason] += 1
            if error.reason.startswith("INVALID") or time.monotonic() > end:
                raise
            time.sleep(0.5)


def kill_in_turn(house: House, kills: int, every_s: float, ended: threading.Event) -> Counter[str]:
    """Kill one process after the other; how often which."""
    done: Counter[str] = Counter()
    for number, what in zip(range(kills), itertools.cycle(("API", "worker", "job", "Redis")), strict=False):
        if ended.wait(every_s):
            break
        index = number % len(house.workers)
        if what == "API":
            house.kill_api()
        elif what == "Redis":
            house.redis.kill()
            house.redis.start()
        elif what == "worker" or not house.kill_job(index):
            house.kill_worker(index)
        done[what] += 1
    return done


def run(folder: Path, asked: argparse.Namespace) -> tuple[list[str], bool]:
    """The table's lines, and whether all was well."""
    pair = write_small_pair(folder)
    others = []
    for number in range(asked.imports):
        place = folder / f"import-{number}"
        place.mkdir()
        others.append(write_small_pair(place, 1.0 + (number + 1) / 1000).scene)
    failed: Counter[str] = Counter()
    with standing_house(folder, threads=1, preload=True, lost_after_s=15) as house:
        house.patience_s = 600.0
        house.start(asked.workers)

        def client() -> Client:
            return Client(house.address, retries=8, worker_timeout_s=None)

        with client() as one:
            scene, thing = one.upload(pair.scene).sha256, one.upload(pair.object).sha256
        pairs = [
            Pair(scene, thing, pair.detection, {"up_axis": "z"}, seed, str(seed), {"pictures": False})
            for seed in range(asked.pairs)
        ]

        def batch() -> list[PairResult]:
            with client() as one:
                found = list(one.batch(pairs))
            bad = [result.error for result in found if result.error is not None]
            if bad:
                raise bad[0]  # for instance WORKER_LOST: the same pairs again
            return found

        def render(seed: int) -> str:
            with client() as one:
                return str(one.render(scene, (), {**_RENDERING, "seed": seed}).job)

        def upload(path: Path) -> str:
            with client() as one:
                return one.upload(path).sha256

        ended = threading.Event()
        with ThreadPoolExecutor(4) as pool:
            killing = pool.submit(kill_in_turn, house, asked.kills, asked.every, ended)
            batches = pool.submit(insisting, batch, failed)
            renders = pool.submit(lambda: [insisting(lambda n=n: render(n), failed) for n in range(asked.renders)])
            imports = pool.submit(lambda: [insisting(lambda p=p: upload(p), failed) for p in others])
            results, rendered, uploaded = batches.result(), renders.result(), imports.result()
            ended.set()
            kills = killing.result()
        with client() as one:
            jobs = Counter(job.status for job in one.jobs())
            fields = {field.sha256: field.state for field in one.fields()}
        left = house.left_behind()
    keys = Counter(result.key for result in results)
    lost = [asked.pairs - len(keys), asked.renders - len(set(rendered)), len(others) - len(set(uploaded))]
    is_well = lost == [0, 0, 0] and max(keys.values()) == 1 and not left
    is_well &= jobs == {"successful": asked.pairs + asked.renders} and set(fields.values()) == {"ready"}
    rows = [
        ("killed", ", ".join(f"{count} {name}" for name, count in kills.items())),
        ("pairs, renderings, imports", f"{asked.pairs}, {asked.renders}, {len(others)}"),
        ("lost", ", ".join(map(str, lost))),
        ("told twice", str(sum(count > 1 for count in keys.values()))),
        ("jobs in the end", ", ".join(f"{count} {status}" for status, count in jobs.items())),
        ("calls that failed and were made again", ", ".join(f"{n} {name}" for name, n in failed.items()) or "none"),
        ("temporary files left", str(len(left))),
        ("all well", "yes" if is_well else "NO"),
    ]
    return ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)], is_well


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, usual in (("kills", 40), ("pairs", 900), ("renders", 60), ("imports", 60), ("workers", 2)):
        parser.add_argument(f"--{name}", type=int, default=usual)
    parser.add_argument("--every", type=float, default=6.0, help="seconds between two kills")
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args()
    before = load()
    with tempfile.TemporaryDirectory(prefix="regnf-") as name:
        lines, is_well = run(Path(name), asked)
    command = f"python -m benchmarks.service_load.kills --kills {asked.kills} --every {asked.every:g}"
    write("Everything killed in turn", headed(command, [before, load()], lines), asked.output)
    return 0 if is_well else 1


if __name__ == "__main__":
    sys.exit(main())
