"""To the previous release and forward again, with jobs in flight: nothing lost, no 500.

    python -m benchmarks.service_load.rollback --previous ../previous [--interpreter PATH] [--output FILE]

``--previous`` is a checkout of the release before, with an environment in `.venv`. Both releases run over one Redis
and one storage, by turns: the previous one, this one, and so on; the first leg begins with empty stores. They are
stopped in order or killed, by turns. Each leg looks at every job and field of the legs before, waits for the jobs that
were left in flight, and leaves jobs of every kind for the next leg: one that runs, some that wait, some that have
ended, one that was cancelled, one whose field is still being imported. Each has a webhook; the receiver refuses until
the second half. Ends with status 1 when anything is lost, ends otherwise than it should, ends twice, or is answered
with a 5xx.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.service_load.clients import ENDS, comparable
from benchmarks.service_load.house import House, Release, standing_house
from benchmarks.service_load.ledger import Ledger, whole_once
from benchmarks.service_load.report import headed, load, write
from benchmarks.service_load.small_fields import EMPTY_BOX, SmallPair, write_small_pair
from benchmarks.service_load.webhook_receiver import SECRET, WebhookReceiver, receiving

_SETTINGS: dict[str, object] = {
    "threads": 1,
    "heartbeat_s": 1.0,
    "lost_after_s": 10.0,
    "shutdown_grace_s": 1.0,
    "webhook_secrets": json.dumps([f"anonymous:{SECRET}"]),
}
_WAITING = 4
"""Jobs that wait when a leg ends."""
_SLOW = {"preset": "paper", "optimization": {"iterations": 400, "stop_residual": 0}, "resampling": {"every": 10_000}}
"""A job that runs for about a quarter of a minute."""
_MAX_WAIT_S = 900.0


@dataclass(frozen=True)
class Leg:
    """One release's turn. killed: how it ends."""

    number: int
    release: Release
    killed: bool


class Caller:
    """Asks the service, and notes every answer that no caller should get."""

    def __init__(self, address: str, ledger: Ledger) -> None:
        self._http = httpx.Client(base_url=address, timeout=60)
        self._ledger = ledger

    def close(self) -> None:
        self._http.close()

    def ask(self, method: str, path: str, **content: Any) -> httpx.Response:
        answer = self._http.request(method, path, **content)
        self._ledger.answers[f"{answer.status_code // 100}xx"] += 1
        if answer.status_code >= 500:
            self._ledger.fault(f"{method} {path}: {answer.status_code} {answer.text[:200]}")
        return answer

    def document(self, method: str, path: str, **content: Any) -> dict[str, Any]:
        answer = self.ask(method, path, **content)
        if answer.status_code >= 400:
            self._ledger.fault(f"{method} {path}: {answer.status_code} {answer.text[:200]}")
            return {}
        document: dict[str, Any] = answer.json()
        return document

    def names(self, what: str, key: str) -> list[str]:
        """All that a list holds, page by page."""
        found, token = [], None
        while True:
            page = self.document("GET", f"/{what}", params={"limit": 20} | ({"page_token": token} if token else {}))
            found += [one[key] for one in page.get(what, [])]
            token = page.get("next_page_token")
            if token is None:
                return found

    def upload(self, content: bytes) -> str:
        return str(self.document("POST", "/fields", content=content).get("sha256"))

    def ended(self, path: str, key: str, ends: tuple[str, ...]) -> dict[str, Any]:
        """The document once it has ended."""
        deadline = time.monotonic() + _MAX_WAIT_S
        while (document := self.document("GET", path)).get(key) not in ends:
            if time.monotonic() > deadline or not document:
                self._ledger.fault(f"{path} is {document.get(key)} after {_MAX_WAIT_S:.0f} s")
                break
            time.sleep(0.2)
        return document


def run_leg(house: House, leg: Leg, ledger: Ledger, pair: SmallPair, receiver: WebhookReceiver) -> None:
    """Start the release, look at what the legs before have left, leave the same for the next, and stop it."""
    house.release = leg.release
    house.start(workers=1)
    caller = Caller(house.address, ledger)
    try:
        _look(caller, ledger)
        _wait_for_all(caller, ledger)
        _look(caller, ledger)
        _leave_jobs(caller, ledger, pair, receiver, leg)
    finally:
        caller.close()
    if leg.killed:
        house.kill()
    else:
        house.end()


def _look(caller: Caller, ledger: Ledger) -> None:
    """Every job and every field is there, once, and says what it said."""
    for what, key, known in (("jobs", "id", ledger.jobs), ("fields", "sha256", ledger.fields)):
        listed = caller.names(what, key)
        if sorted(listed) != sorted(known):
            ledger.fault(f"{what}: {len(listed)} listed, {len(known)} known: {set(listed) ^ set(known)}")
        for name in known:
            ledger.compare(what, name, caller.document("GET", f"/{what}/{name}"))


def _wait_for_all(caller: Caller, ledger: Ledger) -> None:
    for name in ledger.fields:
        ledger.compare("fields", name, caller.ended(f"/fields/{name}", "state", ("ready", "rejected")))
    for name, job in ledger.jobs.items():
        document = caller.ended(f"/jobs/{name}", "status", ENDS)
        ledger.settle(job, document)
        if document.get("status") == "successful":
            ledger.compare("results", name, comparable(caller.document("GET", f"/jobs/{name}/result")))


def _leave_jobs(caller: Caller, ledger: Ledger, pair: SmallPair, receiver: WebhookReceiver, leg: Leg) -> None:
    """Jobs of every kind: the first ones end before the release does, the others are left in flight."""
    numbers = itertools.count(100 * leg.number)
    scene, chair = (caller.upload(path.read_bytes()) for path in (pair.scene, pair.object))
    ledger.expect_field(scene, "ready")
    ledger.expect_field(chair, "ready")
    ledger.expect_field(caller.upload(_no_field(leg.number)), "rejected")
    base = {"scene": scene, "object": chair, "detection": pair.detection}

    def post(ends: str, **changes: Any) -> str:
        number = next(numbers)
        request = base | {"seed": number, "webhook": {"url": receiver.address(number)}} | changes
        job = str(caller.document("POST", "/register", json=request).get("id"))
        ledger.expect_job(job, ends, number, leg.release.name)
        return job

    ended = [post("successful", options={"up_axis": "z"}), post("failed", detection=EMPTY_BOX)]
    for job in ended:
        ledger.settle(ledger.jobs[job], caller.ended(f"/jobs/{job}", "status", ENDS))
    running = post("successful", options=_SLOW)
    caller.ended(f"/jobs/{running}", "status", ("running",))
    cancelled = post("dismissed")
    caller.document("POST", f"/jobs/{cancelled}/cancel")
    for _ in range(_WAITING):
        post("successful", options={"up_axis": "z"})
    late = caller.upload(_shifted(pair.object, leg.number))
    ledger.expect_field(late, "ready")
    post("successful", object=late, options={"up_axis": "z"})
    ledger.left_in_flight(caller.document("GET", f"/jobs/{job}") for job in list(ledger.jobs))


def _shifted(path: Path, number: int) -> bytes:
    """The same object by a little, in a file of its own."""
    with np.load(path) as arrays, tempfile.TemporaryFile() as file:
        np.savez(file, sdf=arrays["sdf"] + np.float32(1e-6 * (number + 1)), bounds=arrays["bounds"])
        file.seek(0)
        return file.read()


def _no_field(number: int) -> bytes:
    with tempfile.TemporaryFile() as file:
        np.savez(file, nothing=np.arange(number + 3))
        file.seek(0)
        return file.read()


def legs_of(previous: Release, this: Release, count: int) -> Iterator[Leg]:
    """The releases by turns; every second change is a kill."""
    for number in range(count):
        yield Leg(number, this if number % 2 else previous, killed=number % 4 in (1, 2))


def run(folder: Path, previous: Release, count: int) -> tuple[Ledger, list[float]]:
    """All legs, then a last one of this release, which leaves nothing in flight."""
    ledger, loads = Ledger(), [load()]
    pair = write_small_pair(folder)
    this = Release("this")
    with (
        receiving() as receiver,
        standing_house(folder, **_SETTINGS, webhook_hosts=json.dumps([receiver.host])) as house,
    ):
        for leg in legs_of(previous, this, count):
            receiver.refuses = leg.number < count // 2
            run_leg(house, leg, ledger, pair, receiver)
            loads.append(load())
        house.release = this
        house.start(workers=1)
        caller = Caller(house.address, ledger)
        _look(caller, ledger)
        _wait_for_all(caller, ledger)
        _look(caller, ledger)
        ledger.webhooks(receiver)
        caller.close()
        house.end()
        ledger.faults += whole_once(house.folder / "state" / "blobs", ledger)
        ledger.faults += [f"left behind: {name}" for name in house.temporary_files()]
    return ledger, loads


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--previous", type=Path, required=True, help="a checkout of the previous release")
    parser.add_argument("--interpreter", type=Path, help="its interpreter; default: .venv/bin/python in the checkout")
    parser.add_argument("--name", default="previous", help="what to call it in the table")
    parser.add_argument("--legs", type=int, default=6)
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args()
    code = asked.previous.resolve()
    previous = Release(asked.name, str(asked.interpreter or code / ".venv" / "bin" / "python"), code)
    with tempfile.TemporaryDirectory(prefix="regnf-rollback-") as name:
        ledger, loads = run(Path(name), previous, asked.legs)
    command = f"python -m benchmarks.service_load.rollback --previous CHECKOUT --name {asked.name} --legs {asked.legs}"
    write("Rollback and forward again", headed(command, loads, ledger.table()), asked.output)
    return 1 if ledger.faults else 0


if __name__ == "__main__":
    sys.exit(main())
