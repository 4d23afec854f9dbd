"""`regnf serve` as a real process, and a look at every process it has made."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx

from regnf_cli.embedded_redis import StartError
from regnf_cli.supervisor import StateLock
from regnf_state.settings import variables
from tests.processes import alive, command_of, descendants_of
from tests.worker.bench import eventually

DEADLINE_S = 40.0


@dataclass
class Service:
    """A started service. ``seen`` are all processes that were ever found below it."""

    process: subprocess.Popen[str]
    state_dir: Path
    address: str
    seen: set[int] = field(default_factory=set)

    def look(self) -> set[int]:
        found = set(descendants_of(self.process.pid))
        self.seen |= found
        return found

    def part(self, name: str) -> int:
        """The process whose command line holds this."""
        return eventually(
            lambda: next((pid for pid in self.look() if name in " ".join(command_of(pid))), 0), name, DEADLINE_S
        )

    def socket_dir(self) -> Path:
        line = " ".join(command_of(self.part("unixsocket:")))
        return Path(line.split("unixsocket:")[1].split("/redis.sock")[0])

    def is_ready(self) -> bool:
        try:
            return httpx.get(f"{self.address}/readyz").status_code == 200
        except httpx.HTTPError:
            return False

    def await_ready(self) -> None:
        eventually(self.is_ready, f"readiness; {self.log()}", DEADLINE_S)

    def log(self) -> str:
        return (self.state_dir.parent / "serve.log").read_text()

    def all_gone(self) -> bool:
        return not any(alive(pid) for pid in self.seen)

    def end(self) -> None:
        """In good order if it still can; what a killed one left behind goes as the next start would have it."""
        self.process.terminate()
        try:
            self.process.wait(DEADLINE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()
        with suppress(StartError), StateLock(self.state_dir):
            pass


def environment(**settings: object) -> dict[str, str]:
    plain = {name: value for name, value in os.environ.items() if not name.startswith("REGNF_")}
    return plain | variables(**settings)


def command(state_dir: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "regnf_cli.main", "serve", "--port", "0", "--state-dir", str(state_dir), *arguments]


def start(state_dir: Path, *arguments: str, **settings: object) -> Service:
    """Start a service and wait for the line that tells its address."""
    state_dir.parent.mkdir(parents=True, exist_ok=True)
    with (state_dir.parent / "serve.log").open("a") as log:
        process = subprocess.Popen(
            command(state_dir, *arguments),
            env=environment(**settings),
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
    assert process.stdout is not None
    line = process.stdout.readline()
    service = Service(process, state_dir, "")
    if "http://" not in line:
        service.end()
        raise AssertionError(f"it did not start: {service.log()}")
    service.address = next(word for word in line.split() if word.startswith("http://"))
    service.look()
    return service
