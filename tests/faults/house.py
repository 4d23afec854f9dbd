"""A service of several processes, each of which a test may kill: Redis, an object store, the API, workers."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
from redis import Redis

from regnf_state.redis.queue import JobQueue
from tests.contract.world import BOX, field_bytes, sha256
from tests.faults.pace import Pace
from tests.faults.stores import Bucket, Store
from tests.restartable_redis import RestartableRedis
from tests.worker.bench import eventually

ENDS = ("successful", "failed", "dismissed")
DEADLINE_S = 130.0
"""A little more than the service promises: whoever is late is told by how much."""


@dataclass
class House:
    """The service. Over an object store API and workers have a folder each, as if on machines of their own."""

    folder: Path
    pace: Pace
    server: RestartableRedis
    redis: Redis
    store: Store
    environment: dict[str, str]
    listener: socket.socket
    client: httpx.Client
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    # processes

    def state(self, role: str) -> Path:
        """The state folder of the API or of the workers."""
        return self.folder / (role if isinstance(self.store, Bucket) else "state")

    @property
    def gates(self) -> Path:
        """Where jobs look whether they shall wait."""
        return Path(self.environment["REGNF_TEST_GATES"])

    def start(self, role: str, *arguments: str, **variables: str) -> subprocess.Popen[bytes]:
        state = self.state(role)
        state.mkdir(exist_ok=True)
        environment = self.environment | {"REGNF_STATE_DIR": str(state)} | variables
        with (self.folder / f"{role}-{len(self.processes)}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", f"tests.faults.{role}", *arguments],
                env=environment,
                stderr=log,
                pass_fds=[self.listener.fileno()],
            )
        self.processes.append(process)
        return process

    def start_both(self) -> tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]:
        """The API and a worker, at the same time."""
        worker = self.start("worker")
        api = self.start_api()
        eventually(lambda: self.live_workers() or worker.poll() is not None, self.log)
        assert worker.poll() is None, self.log()
        return api, worker

    def start_api(self, **variables: str) -> subprocess.Popen[bytes]:
        process = self.start("api", str(self.listener.fileno()), **variables)
        eventually(lambda: self._answers() or process.poll() is not None, self.log)
        assert process.poll() is None, self.log()
        return process

    def start_worker(self, **variables: str) -> subprocess.Popen[bytes]:
        before = self.live_workers()
        process = self.start("worker", **variables)
        eventually(lambda: self.live_workers() > before or process.poll() is not None, self.log)
        assert process.poll() is None, self.log()
        return process

    def live_workers(self) -> int:
        return JobQueue(self.redis).live_workers()

    def _answers(self) -> bool:
        try:
            return self.client.get("/healthz", timeout=2.0).status_code == 200
        except httpx.TransportError:
            return False

    def stop(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()

    def log(self) -> str:
        return "\n".join(f"--- {path.name}\n{path.read_text()}" for path in sorted(self.folder.glob("*.log")))

    # jobs

    def hold(self, gate: str = "hold") -> None:
        """Have jobs wait: in the engine (`hold`), or once their result stands (`hold-end`)."""
        (self.gates / gate).write_bytes(b"")

    def let_go(self, gate: str = "hold") -> None:
        (self.gates / gate).unlink()

    def request(self, seed: int = 0) -> dict[str, Any]:
        """A registration of two fields, which are uploaded if they are not there."""
        names = [self.upload(field_bytes(name)) for name in ("scene", "object")]
        options = {"preset": "paper"}
        return {"scene": names[0], "object": names[1], "detection": BOX, "seed": seed, "options": options}

    def upload(self, data: bytes) -> str:
        self.client.put(f"/fields/{sha256(data)}", content=data).raise_for_status()
        return sha256(data)

    def submit(self, seed: int = 0) -> str:
        answer = self.client.post("/register", json=self.request(seed))
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    def running(self, seed: int = 0) -> str:
        """A job that a worker has begun, and that waits to be let go."""
        self.hold()
        job_id = self.submit(seed)
        eventually(lambda: self.job(job_id)["phase"] == "optimizing", self.log)
        return job_id

    def job(self, job_id: str) -> dict[str, Any]:
        answer = self.client.get(f"/jobs/{job_id}")
        assert answer.status_code == 200, answer.text
        document: dict[str, Any] = answer.json()
        return document

    def field(self, name: str) -> dict[str, Any]:
        document: dict[str, Any] = self.client.get(f"/fields/{name}").raise_for_status().json()
        return document

    def reaches(self, job_id: str, status: str) -> dict[str, Any]:
        return eventually(lambda: job if (job := self.job(job_id))["status"] == status else None, self.log, DEADLINE_S)

    def finished(self, job_id: str) -> dict[str, Any]:
        return eventually(lambda: job if (job := self.job(job_id))["status"] in ENDS else None, self.log, DEADLINE_S)


def plain_environment() -> dict[str, str]:
    """This process' environment without regnf's settings."""
    return {name: value for name, value in os.environ.items() if not name.startswith("REGNF_")}
