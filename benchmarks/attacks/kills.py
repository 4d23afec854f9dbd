"""Processes killed at random while fields are imported and registered: what was accepted has to end whole."""

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
from typing import Any

import httpx
import numpy as np

from benchmarks.attacks.outcome import Outcome
from benchmarks.service_load.house import House, running_house
from benchmarks.service_load.small_fields import SmallPair, write_small_pair
from regnf_state.manifest import manifest_key
from tests.worker.bench import children_of

_CLIENTS = 4
_MOST_S = 240.0
_SETTINGS: dict[str, object] = {"threads": 1, "heartbeat_s": 1.0, "lost_after_s": 8.0, "rate_limit_per_s": 0}


def attack_by_kills(folder: Path, kills: int, seed: int) -> Outcome:
    """Clients upload a new room and register in it, over and over, until ``kills`` processes were killed."""
    outcome, stop = Outcome(), threading.Event()
    with running_house(folder, workers=2, **_SETTINGS) as house:
        pair = write_small_pair(folder)
        chair = _upload(house, pair.object.read_bytes(), outcome)
        with ThreadPoolExecutor(_CLIENTS + 1) as pool:
            killer = pool.submit(_kill, house, kills, seed, outcome, stop)
            clients = [pool.submit(_client, house, pair, chair, n, outcome, stop) for n in range(_CLIENTS)]
            killer.result()
            for client in clients:
                client.result()
        end = time.monotonic() + 60
        while (left := house.temporary_files()) and time.monotonic() < end:
            time.sleep(0.5)
        outcome.faults += [f"left behind: {name}" for name in left]
    return outcome


def _kill(house: House, kills: int, seed: int, outcome: Outcome, stop: threading.Event) -> None:
    random = Random(seed)
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
            if deeds[name]():
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
        pids = [grandchild for child in pids for grandchild in _children(child)]
    if not pids:
        return False
    with suppress(ProcessLookupError):
        os.kill(random.choice(pids), signal.SIGKILL)
        return True
    return False


def _children(pid: int) -> list[int]:
    with suppress(FileNotFoundError, ProcessLookupError):
        return children_of(pid)
    return []


def _api(house: House) -> bool:
    house.kill_api()
    return True


def _redis(house: House) -> bool:
    house.redis.kill()
    house.redis.start()
    return True


def _client(house: House, pair: SmallPair, chair: str, number: int, outcome: Outcome, stop: threading.Event) -> None:
    """Upload a room nobody has uploaded, register in it, check the result; until told to stop."""
    turn = 0
    while not stop.is_set():
        turn += 1
        try:
            room = _upload(house, _variant(pair, number * 100_000 + turn), outcome)
            request = {"scene": room, "object": chair, "detection": pair.detection, "seed": turn}
            _register(house, request, outcome)
        except (TimeoutError, AssertionError) as error:
            outcome.fault(f"client {number}, turn {turn}: {error}")


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


def _upload(house: House, data: bytes, outcome: Outcome) -> str:
    answer = _ask(lambda: httpx.post(f"{house.address}/fields", content=data, timeout=60), (200, 201, 202), outcome)
    place = f"{house.address}{answer.headers['Location']}"
    outcome.inputs += 1
    document = _followed(place, lambda one: one["state"] != "validating", outcome)
    outcome.ends[f"field {document['state']}"] += 1
    assert document["state"] == "ready", f"an upload ended as {document.get('error')}"
    return str(document["sha256"])


def _register(house: House, request: dict[str, Any], outcome: Outcome) -> None:
    answer = _ask(lambda: httpx.post(f"{house.address}/register", json=request, timeout=60), (200, 202), outcome)
    job = answer.json()["id"]
    outcome.inputs += 1
    document = _followed(f"{house.address}/jobs/{job}", lambda one: one["status"] in _ENDS, outcome)
    reason = (document.get("error") or {}).get("reason", "")
    outcome.ends[f"job {document['status']} {reason}".strip()] += 1
    if document["status"] == "failed":
        assert reason == "WORKER_LOST", f"job {job} failed: {reason}"
        return
    result = _ask(lambda: httpx.get(f"{house.address}/jobs/{job}/result", timeout=60), (200,), outcome).json()
    assert result["verdict"] == "registered", f"job {job}: {result['verdict']}"
    manifests = list((house.folder / "state" / "blobs").glob(manifest_key(job)))
    assert len(manifests) == 1, f"job {job} has {len(manifests)} manifests"


_ENDS = ("successful", "failed", "dismissed")


def _followed(place: str, ended: Callable[[dict[str, Any]], bool], outcome: Outcome) -> dict[str, Any]:
    end = time.monotonic() + _MOST_S
    while True:
        document: dict[str, Any] = _ask(lambda: httpx.get(place, timeout=60), (200,), outcome).json()
        if ended(document):
            return document
        if time.monotonic() > end:
            raise TimeoutError(f"{place} has not ended after {_MOST_S:.0f} s: {str(document)[:400]}")
        time.sleep(0.2)


def _ask(call: Callable[[], httpx.Response], statuses: tuple[int, ...], outcome: Outcome) -> httpx.Response:
    """An answer with one of the statuses: asked for again while the service is away, as a client should."""
    end = time.monotonic() + _MOST_S
    while True:
        try:
            answer = call()
        except httpx.TransportError as error:
            outcome.ends[f"asked again: {type(error).__name__}"] += 1
        else:
            if answer.status_code in statuses:
                return answer
            reason = answer.json().get("reason", "")
            outcome.ends[f"asked again: {answer.status_code} {reason}"] += 1
            if answer.status_code not in (404, 409, 429, 503, 507):
                raise AssertionError(f"{answer.request.url}: {answer.status_code} {reason}")
        if time.monotonic() > end:
            raise TimeoutError(f"no answer within {_MOST_S:.0f} s")
        time.sleep(0.3)
