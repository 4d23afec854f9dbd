"""The real thing: a private Redis, a worker process, and the application under uvicorn, all ended afterwards."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import httpx

from regnf_state.settings import variables
from tests.listing import files_below
from tests.redis_server import private_redis

DEADLINE_S = 60.0
MAX_UPLOAD = 128 << 20
_Value = TypeVar("_Value")


def eventually(look: Callable[[], _Value | None], what: str, deadline_s: float = DEADLINE_S) -> _Value:
    end = time.monotonic() + deadline_s
    while not (value := look()):
        assert time.monotonic() < end, f"{what} did not come about within {deadline_s} s"
        time.sleep(0.05)
    return value


@dataclass
class Live:
    port: int
    folder: Path
    api: subprocess.Popen[bytes]
    worker: subprocess.Popen[bytes] | None

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def client(self) -> httpx.Client:
        return httpx.Client(base_url=self.address, timeout=60)

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=DEADLINE_S)

    def peak_memory(self) -> int:
        """The most memory the API's process has ever held, bytes."""
        lines = Path(f"/proc/{self.api.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))

    def files(self) -> set[str]:
        """Every file in the blob store, unfinished ones included; not what the journal says of them."""
        root = self.folder / "blobs"
        names = {path.relative_to(root).as_posix() for path in files_below(root)}
        return {name for name in names if not name.startswith("journal/")}

    def log(self) -> str:
        return "\n".join(path.read_text() for path in sorted(self.folder.glob("*.log")))


@contextmanager
def live_service(folder: Path, with_worker: bool = True, **settings: object) -> Iterator[Live]:
    """Start everything; the API answers once this yields, and is ready if it has a worker."""
    with private_redis() as redis_url, socket.create_server(("127.0.0.1", 0)) as listener, ExitStack() as stack:
        plain = {name: value for name, value in os.environ.items() if not name.startswith("REGNF_")}
        usual = {"redis_url": redis_url, "state_dir": folder, "max_upload_bytes": MAX_UPLOAD, "device": "cpu"}
        environment = plain | variables(**usual | settings)

        def start(name: str, *module: str, passed: tuple[int, ...] = ()) -> subprocess.Popen[bytes]:
            return stack.enter_context(_process(folder / f"{name}.log", [*module], environment, passed))

        number = listener.fileno()
        api = start("api", "regnf_cli.api_process", str(number), passed=(number,))
        worker = start("worker", "regnf_worker.main") if with_worker else None
        live = Live(listener.getsockname()[1], folder, api, worker)
        awaited = "/readyz" if with_worker else "/healthz"
        eventually(lambda: _status(live, awaited) == 200, f"{awaited}; {live.log()}")
        yield live


@contextmanager
def _process(
    log: Path, module: list[str], environment: dict[str, str], passed: tuple[int, ...]
) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("wb") as file:
        command = [sys.executable, "-m", *module]
        process = subprocess.Popen(command, env=environment, stdout=file, stderr=file, pass_fds=passed)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _status(live: Live, path: str) -> int:
    try:
        return httpx.get(live.address + path, timeout=5).status_code
    except httpx.TransportError:
        assert live.api.poll() is None, live.log()
        return 0
