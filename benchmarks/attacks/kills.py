"""Processes killed at random while fields are imported and registered: what was accepted has to end whole.

It has to end within four minutes of the last death. It may end without a result only if processes have died more often
meanwhile than the service repeats work.
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from random import Random

import numpy as np

from benchmarks.attacks.deaths import Deaths
from benchmarks.attacks.outcome import Outcome
from benchmarks.attacks.persistent_client import PersistentClient
from benchmarks.service_load.house import House, running_house
from benchmarks.service_load.small_fields import SmallPair, write_small_pair
from tests.processes import children_of, descendants_of

_CLIENTS = 4
_SETTINGS: dict[str, object] = {"threads": 1, "heartbeat_s": 1.0, "lost_after_s": 8.0, "quota_calls_per_s": 0}


def attack_by_kills(folder: Path, kills: int, seed: int) -> Outcome:
    """Clients upload a new room and register in it, over and over, until ``kills`` processes were killed."""
    outcome, stop, deaths = Outcome(), threading.Event(), Deaths()
    with running_house(folder, workers=2, **_SETTINGS) as house:
        pair = write_small_pair(folder)
        client = PersistentClient(house, outcome, deaths)
        chair = client.upload(pair.object.read_bytes())
        with ThreadPoolExecutor(_CLIENTS + 1) as pool:
            killer = pool.submit(_kill, house, kills, Random(seed), outcome, stop, deaths)
            goings = [pool.submit(_go_on, client, pair, chair, number, stop) for number in range(_CLIENTS)]
            for going in (killer, *goings):
                going.result()
        outcome.faults += [f"left behind: {name}" for name in house.left_behind()]
    return outcome


def _kill(house: House, kills: int, random: Random, outcome: Outcome, stop: threading.Event, deaths: Deaths) -> None:
    deeds: dict[str, Callable[[], bool]] = {
        "worker": lambda: _worker(house, random),
        "process of a job or import": lambda: _inner(house, random, deep=False),
        "process inside the gate": lambda: _inner(house, random, deep=True),
        "API": lambda: _api(house),
        "Redis": lambda: _redis(house),
        "worker, told to stop": lambda: _told_to_stop(house, random),
        "worker, frozen for a while": lambda: _frozen(house.workers[random.randrange(len(house.workers))].pid, random),
        "API, frozen for a while": lambda: house.api is not None and _frozen(house.api.pid, random),
    }
    try:
        while outcome.kills < kills:
            time.sleep(random.uniform(1.0, 6.0))
            name = random.choice(list(deeds))
            if deaths.during(name, deeds[name]):
                outcome.kills += 1
                outcome.ends[f"killed: {name}"] += 1
    finally:
        stop.set()


def _worker(house: House, random: Random) -> bool:
    house.kill_worker(random.randrange(len(house.workers)))
    return True


def _told_to_stop(house: House, random: Random) -> bool:
    """A worker gets SIGTERM; if it lets its job go on for long, it is killed after a while, as supervisors do."""
    index = random.randrange(len(house.workers))
    house.workers[index].terminate()
    with suppress(subprocess.TimeoutExpired):
        house.workers[index].wait(random.uniform(0.0, 20.0))
    house.kill_worker(index)
    return True


def _frozen(pid: int, random: Random) -> bool:
    """A process stands still, for less or more than the time after which it counts as lost."""
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGSTOP)
        time.sleep(random.choice([1.0, 5.0, 12.0]))
        os.kill(pid, signal.SIGCONT)
        return True
    return False


def _inner(house: House, random: Random, deep: bool) -> bool:
    """Kill what a worker has forked; ``deep``: the process that reads an upload, inside of that."""
    pids = [child for worker in house.workers for child in children_of(worker.pid)]
    if deep:
        pids = [grandchild for child in pids for grandchild in descendants_of(child)]
    if not pids:
        return False
    with suppress(ProcessLookupError):
        os.kill(random.choice(pids), signal.SIGKILL)
        return True
    return False


def _api(house: House) -> bool:
    house.kill_api()
    return True


def _redis(house: House) -> bool:
    house.redis.kill()
    house.redis.start()
    return True


def _go_on(client: PersistentClient, pair: SmallPair, chair: str, number: int, stop: threading.Event) -> None:
    """Upload a room nobody has uploaded, register in it, check the result; until told to stop."""
    turn = 0
    while not stop.is_set():
        turn += 1
        try:
            room = client.upload(_variant(pair, number * 100_000 + turn))
            if room is not None:
                client.register({"scene": room, "object": chair, "detection": pair.detection, "seed": turn})
        except (TimeoutError, AssertionError) as error:
            client.outcome.fault(f"client {number}, turn {turn}: {error}")


def _variant(pair: SmallPair, number: int) -> bytes:
    """The room with a name of its own in the file: other bytes, the same field."""
    folder = pair.scene.parent / "variants"
    folder.mkdir(exist_ok=True)
    with np.load(pair.scene) as held:
        arrays = dict(held)
    arrays["bounds"] = arrays["bounds"] * (1 + number * 1e-9)
    path = folder / f"{number}.npz"
    np.savez(path, **arrays)
    data = path.read_bytes()
    path.unlink()
    return data
