"""How long an honest caller waits for its result while another asks for all that it can, against being alone.

    python -m benchmarks.service_load.greed [--rounds 5] [--output benchmarks/results/service_greed.md]

One service with tokens for two callers, and two workers. The honest caller registers an object of its own again and
again, one at a time, and is timed from its POST to its result: alone, then beside each kind of greed. Every kind of
greed goes on, from several threads, for as long as the honest caller is timed:

imports       variants of a file that costs the workers seconds, as many as are taken
jobs          registrations that differ in their seeds, as many as are taken
records       registrations that are cancelled at once
bytes         uploads of some megabytes that are no field
streams       event streams that are opened and never read
JSON          bodies close to the largest that are taken, of members that nobody knows

The bar is twice the time alone, by the medians. Ends with status 1 where it does not hold.
"""

from __future__ import annotations

import argparse
import io
import itertools
import json
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.service_load.house import House, running_house
from benchmarks.service_load.report import headed, load, write
from benchmarks.service_load.small_fields import SmallPair, write_small_pair
from regnf_client import Client

_TOKENS = {"greedy": "greedy-caller-of-the-benchmark", "honest": "honest-caller-of-the-benchmark"}
_OPTIONS = {"up_axis": "z"}
_THREADS = 4
_BAR = 2.0
_HEAD_START_S = 5.0
"""How long the greedy caller is left alone with the service before the honest one begins."""
_NODES = 96
_REFUSED_PAUSE_S = 0.05
_numbers = itertools.count(1)


@dataclass
class Greedy:
    """The greedy caller; what it was answered, by status and reason."""

    client: httpx.Client
    request: dict[str, Any]
    answers: Counter[str]

    def ask(self, method: str, path: str, **content: Any) -> httpx.Response | None:
        """One call; None when the service closed the connection. A refusal is taken for a short pause only."""
        try:
            answer = self.client.request(method, path, **content)
        except httpx.TransportError as error:
            self.answers[type(error).__name__] += 1
            return None
        refused = answer.status_code >= 400
        self.answers[f"{answer.status_code} {answer.json()['reason']}" if refused else str(answer.status_code)] += 1
        if answer.status_code in (429, 503):
            time.sleep(_REFUSED_PAUSE_S)
        return answer

    def register(self) -> dict[str, Any] | None:
        answer = self.ask("POST", "/register", json={**self.request, "seed": next(_numbers)})
        return answer.json() if answer is not None and answer.status_code == 202 else None


def imports(greedy: Greedy) -> None:
    """A dense grid that differs in one value."""
    buffer = io.BytesIO()
    values = np.ones((_NODES,) * 3, dtype=np.float32)
    values[1:-1, 1:-1, 1:-1] = -1.0
    values[0, 0, 0] = next(_numbers)
    np.savez(buffer, sdf=values, bounds=np.array([[-1.0] * 3, [1.0] * 3]))
    greedy.ask("POST", "/fields", content=buffer.getvalue())


def jobs(greedy: Greedy) -> None:
    greedy.register()


def records(greedy: Greedy) -> None:
    job = greedy.register()
    if job is not None:
        greedy.ask("POST", f"/jobs/{job['id']}/cancel")


def byte_loads(greedy: Greedy) -> None:
    """The beginning of a safetensors file, and then nothing of sense."""
    header = json.dumps({"__metadata__": {"n": str(next(_numbers))}}).encode()
    greedy.ask("POST", "/fields", content=(len(header).to_bytes(8, "little") + header).ljust(8 << 20, b"\0"))


def streams(greedy: Greedy) -> None:
    job = greedy.register()
    if job is None:
        return
    with suppress(httpx.TransportError), greedy.client.stream("GET", f"/jobs/{job['id']}/events") as events:
        greedy.answers[f"stream {events.status_code}"] += 1
        time.sleep(1.0)


def bodies(greedy: Greedy) -> None:
    body = json.dumps({f"unknown{number}": number for number in range(50_000)})
    greedy.ask("POST", "/register", content=body, headers={"Content-Type": "application/json"})


GREED: dict[str, Callable[[Greedy], None]] = {
    "imports": imports,
    "jobs": jobs,
    "records": records,
    "bytes": byte_loads,
    "streams": streams,
    "JSON": bodies,
}


@contextmanager
def going_on(act: Callable[[Greedy], None], greedy: Greedy) -> Iterator[None]:
    """Have the greedy caller act from several threads until the block ends."""
    end = threading.Event()

    def work() -> None:
        while not end.is_set():
            act(greedy)

    threads = [threading.Thread(target=work) for _ in range(_THREADS)]
    for thread in threads:
        thread.start()
    try:
        end.wait(_HEAD_START_S)
        yield
    finally:
        end.set()
        for thread in threads:
            thread.join()


def timed(client: httpx.Client, request: dict[str, Any], rounds: int) -> list[float]:
    """Seconds from POST to the end of so many registrations, one after another."""
    seconds = []
    for _ in range(rounds):
        begun = time.monotonic()
        answer = client.post("/register", json={**request, "seed": next(_numbers)})
        answer.raise_for_status()
        job = answer.json()
        while job["status"] not in ("successful", "failed", "dismissed"):
            job = client.get(f"/jobs/{job['id']}", params={"wait": 30}).raise_for_status().json()
        if job["status"] != "successful":
            raise RuntimeError(f"the honest caller's job: {job['status']} {job['error']}")
        seconds.append(time.monotonic() - begun)
    return seconds


def measure(folder: Path, kind: str, rounds: int) -> tuple[list[float], list[float], Counter[str]]:
    """The honest caller's times alone and beside one kind of greed; the greedy one's answers."""
    pair = write_small_pair(folder)
    tokens = json.dumps([f"{caller}:{token}" for caller, token in _TOKENS.items()])
    answers: Counter[str] = Counter()
    with ExitStack() as stack:
        house = stack.enter_context(
            running_house(folder, 2, _TOKENS["honest"], threads=1, preload=True, api_tokens=tokens)
        )
        requests = {caller: _uploaded(house, pair, caller) for caller in _TOKENS}
        clients = {caller: stack.enter_context(_client(house, caller)) for caller in _TOKENS}
        timed(clients["honest"], requests["honest"], 1)  # the object's model
        timed(clients["greedy"], requests["greedy"], 1)
        alone = timed(clients["honest"], requests["honest"], rounds)
        with going_on(GREED[kind], Greedy(clients["greedy"], requests["greedy"], answers)):
            beside = timed(clients["honest"], requests["honest"], rounds)
    return alone, beside, answers


def _uploaded(house: House, pair: SmallPair, caller: str) -> dict[str, Any]:
    with Client(house.address, _TOKENS[caller]) as service:
        return {**pair.upload(service), "options": _OPTIONS}


def _client(house: House, caller: str) -> httpx.Client:
    headers = {"Authorization": f"Bearer {_TOKENS[caller]}"}
    return httpx.Client(base_url=house.address, headers=headers, timeout=120)


def row(kind: str, alone: list[float], beside: list[float], answers: Counter[str]) -> str:
    ratio = statistics.median(beside) / statistics.median(alone)
    told = ", ".join(f"{name}: {count}" for name, count in answers.most_common(4))
    return (
        f"| {kind} | {_cell(alone)} | {_cell(beside)} | {ratio:.2f} | {'yes' if ratio <= _BAR else '**no**'} | {told} |"
    )


def _cell(seconds: list[float]) -> str:
    return f"{statistics.median(seconds):.2f} ({min(seconds):.2f} to {max(seconds):.2f})"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--kinds", nargs="+", choices=GREED, default=list(GREED))
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    rows, loads = [], [load()]
    for kind in arguments.kinds:
        with tempfile.TemporaryDirectory(prefix="regnf-") as folder:
            rows.append(row(kind, *measure(Path(folder), kind, arguments.rounds)))
        loads.append(load())
        sys.stderr.write(rows[-1] + "\n")
    lines = [
        "Seconds from POST to result of the honest caller's registrations, median, least and most; what the greedy one "
        "was answered, and how often.",
        "",
        "| greed | alone, s | beside it, s | ratio | within the bar of 2 | answers to the greedy one |",
        "|---|---|---|---|---|---|",
        *rows,
    ]
    command = f"python -m benchmarks.service_load.greed --rounds {arguments.rounds}"
    write("A greedy caller beside an honest one", headed(command, loads, lines), arguments.output)
    return 1 if any("**no**" in one for one in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
