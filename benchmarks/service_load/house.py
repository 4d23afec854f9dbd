"""A service of separate processes, each of which may be killed and started again: Redis, the API, workers."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from redis import Redis

from regnf_state.redis.client import connect
from regnf_state.redis.queue import JobQueue
from regnf_state.settings import variables
from tests.processes import children_of
from tests.restartable_redis import RestartableRedis, restartable_redis
from tests.worker.bench import eventually


@dataclass(frozen=True)
class Release:
    """Code to run: an interpreter that finds it, and its folder; without these, this code."""

    name: str
    interpreter: str = sys.executable
    code: Path | None = None


@dataclass
class House:
    """The running processes, of the code in ``release``."""

    folder: Path
    redis: RestartableRedis
    listener: socket.socket
    settings: dict[str, object]
    release: Release = field(default_factory=lambda: Release("this"))
    api: subprocess.Popen[bytes] | None = None
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)
    token: str | None = None
    """Of the caller that asks whether the service is ready, where it needs one."""
    patience_s: float = 60.0
    """How long processes may take to start: on a crowded machine a worker that loads the engine first takes minutes."""

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.listener.getsockname()[1]}"

    def start(self, workers: int) -> None:
        """The API, and so many workers; returns once it is ready."""
        self.launch_api()
        self.workers = [self._worker(index) for index in range(workers)]
        eventually(self._ready if workers else self._answers, self.log, self.patience_s)

    def launch_api(self) -> None:
        """The API's process, however far it gets."""
        self.api = self._launch("api", ["regnf_cli.api_process", str(self.listener.fileno())])

    def kill_api(self) -> None:
        """Kill the API's process, and start another."""
        assert self.api is not None
        self.api.kill()
        self.api.wait()
        self.launch_api()

    def kill_worker(self, index: int) -> None:
        """Kill a worker (its child dies with it), unless it has ended, and start another."""
        self.workers[index].kill()
        self.workers[index].wait()
        self.workers[index] = self._worker(index)

    def kill_job(self, index: int) -> bool:
        """Kill the process of the job that a worker runs; whether there was one."""
        for child in children_of(self.workers[index].pid)[-1:]:  # beside it, one may draw or finish
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
                return True
        return False

    def have_workers(self, count: int) -> None:
        """So many workers from now on, all of them live."""
        while len(self.workers) > count:
            worker = self.workers.pop()
            worker.terminate()
            worker.wait(30)
        self.workers += [self._worker(index) for index in range(len(self.workers), count)]
        with connect(self.redis.url) as client:
            eventually(lambda: JobQueue(client).live_workers() == count, self.log, self.patience_s)

    def empty_redis(self) -> None:
        """Everything that it holds is lost."""
        with connect(self.redis.url) as client:
            client.flushall()

    def api_memory(self) -> int:
        """What the API's process holds, bytes."""
        assert self.api is not None
        assert self.api.poll() is None, self.log()
        return _entry(self.api.pid, "VmRSS")

    def api_peak(self) -> int:
        """The most that the API's process has ever held, bytes."""
        assert self.api is not None
        return _entry(self.api.pid, "VmHWM")

    def redis_memory(self, client: Redis) -> int:
        """What Redis says that it uses, bytes."""
        return int(client.info("memory")["used_memory"])

    def temporary_files(self) -> list[str]:
        """What no process should have left behind."""
        state = self.folder / "state"
        roots = (state / "scratch", state / "blobs" / ".tmp")
        return [
            str(path.relative_to(state))
            for root in roots
            for path in root.rglob("*")
            if path.is_file() and not path.name.endswith(".lock")  # locks stay
        ]

    def left_behind(self, within_s: float = 60.0) -> list[str]:
        """The temporary files that stay: a process may still be at the pictures of a result that is out."""
        end = time.monotonic() + within_s
        while (left := self.temporary_files()) and time.monotonic() < end:
            time.sleep(0.2)
        return left

    def log(self) -> str:
        return "\n".join(path.read_text(errors="replace") for path in sorted(self.folder.glob("*.log")))

    def kill(self) -> None:
        """Kill the API and the workers at once, as a failing machine would."""
        for process in (*self.workers, *([self.api] if self.api is not None else [])):
            process.kill()
            process.wait()

    def end(self) -> None:
        for process in (*self.workers, *([self.api] if self.api is not None else [])):
            process.terminate()
        for process in (*self.workers, *([self.api] if self.api is not None else [])):
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _worker(self, index: int) -> subprocess.Popen[bytes]:
        return self._launch(f"worker-{index}", ["regnf_worker.main"])

    def _launch(self, name: str, module: list[str]) -> subprocess.Popen[bytes]:
        plain = {key: value for key, value in os.environ.items() if not key.startswith("REGNF_")}
        usual = {"redis_url": self.redis.url, "state_dir": self.folder / "state", "device": "cpu"}
        chosen = usual | self.settings
        environment = plain | variables(**chosen)
        with (self.folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                [self.release.interpreter, "-m", *module],
                cwd=self.release.code,
                env=environment,
                stdout=log,
                stderr=log,
                pass_fds=[self.listener.fileno()],
            )

    def _ready(self) -> bool:
        return self._status("/readyz") == 200

    def _answers(self) -> bool:
        return self._status("/healthz") == 200

    def _status(self, path: str) -> int:
        assert self.api is not None
        assert self.api.poll() is None, self.log()
        headers = {"Authorization": f"Bearer {self.token}"} if self.token else {}
        try:
            return httpx.get(self.address + path, headers=headers, timeout=5).status_code
        except httpx.TransportError:
            return 0


def _entry(pid: int, entry: str) -> int:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(entry))


@contextmanager
def running_house(folder: Path, workers: int, token: str | None = None, **settings: object) -> Iterator[House]:
    """Start everything below ``folder``; ready once this yields. ``token``: where the settings name callers."""
    with standing_house(folder, **settings) as house:
        house.token = token
        house.start(workers)
        yield house


@contextmanager
def standing_house(folder: Path, **settings: object) -> Iterator[House]:
    """The same with Redis alone; what was started is ended."""
    (folder / "state").mkdir(parents=True, exist_ok=True)
    with restartable_redis(folder / "redis") as redis, socket.create_server(("127.0.0.1", 0)) as listener:
        house = House(folder, redis, listener, dict(settings))
        try:
            yield house
        finally:
            house.end()
