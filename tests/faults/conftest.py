"""A service of several processes, each of which a test may kill: Redis, an object store, the API, a worker."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
from redis import Redis

from service.redis_client import connect
from tests.contract.world import BOX, field_bytes, sha256
from tests.object_store import ObjectServer
from tests.redis_server import private_redis
from tests.worker.bench import eventually

ENDS = ("successful", "failed", "dismissed")


@dataclass
class House:
    """The service. API and workers have a folder each, as if they were on machines of their own."""

    folder: Path
    redis: Redis
    objects: ObjectServer
    environment: dict[str, str]
    listener: socket.socket
    client: httpx.Client
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def start(self, *arguments: str, **variables: str) -> subprocess.Popen[bytes]:
        state = self.folder / arguments[0]
        state.mkdir(exist_ok=True)
        environment = self.environment | {"REGNF_STATE_DIR": str(state)} | variables
        with (self.folder / f"{arguments[0]}-{len(self.processes)}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "tests.faults.parts", *arguments],
                env=environment,
                stderr=log,
                pass_fds=[self.listener.fileno()],
            )
        self.processes.append(process)
        return process

    def start_api(self, **variables: str) -> subprocess.Popen[bytes]:
        process = self.start("api", str(self.listener.fileno()), **variables)
        eventually(lambda: self._answers() or process.poll() is not None, self.log)
        assert process.poll() is None, self.log()
        return process

    def start_worker(self) -> subprocess.Popen[bytes]:
        process = self.start("worker")
        eventually(lambda: self.client.get("/readyz").status_code == 200 or process.poll() is not None, self.log)
        assert process.poll() is None, self.log()
        return process

    def _answers(self) -> bool:
        try:
            return self.client.get("/healthz", timeout=2.0).status_code == 200
        except httpx.TransportError:
            return False

    def hold_jobs(self) -> None:
        (self.folder / "worker").mkdir(exist_ok=True)
        (self.folder / "worker" / "hold").write_bytes(b"")

    def let_jobs_go(self) -> None:
        (self.folder / "worker" / "hold").unlink()

    def request(self, seed: int = 0) -> dict[str, Any]:
        """A registration of two fields, which are uploaded if they are not there."""
        names = []
        for name in ("scene", "object"):
            data = field_bytes(name)
            self.client.put(f"/fields/{sha256(data)}", content=data).raise_for_status()
            names.append(sha256(data))
        options = {"preset": "paper"}
        return {"scene": names[0], "object": names[1], "detection": BOX, "seed": seed, "options": options}

    def submit(self, seed: int = 0) -> str:
        answer = self.client.post("/register", json=self.request(seed))
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    def job(self, job_id: str) -> dict[str, Any]:
        answer = self.client.get(f"/jobs/{job_id}")
        assert answer.status_code == 200, answer.text
        document: dict[str, Any] = answer.json()
        return document

    def reaches(self, job_id: str, status: str) -> dict[str, Any]:
        return eventually(lambda: job if (job := self.job(job_id))["status"] == status else None, self.log)

    def finished(self, job_id: str) -> dict[str, Any]:
        return eventually(lambda: job if (job := self.job(job_id))["status"] in ENDS else None, self.log)

    def log(self) -> str:
        return "\n".join(path.read_text() for path in sorted(self.folder.glob("*.log")))


@pytest.fixture
def house(tmp_path: Path, objects: ObjectServer) -> Iterator[House]:
    with ExitStack() as stack:
        url = stack.enter_context(private_redis())
        redis = stack.enter_context(connect(url))
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        address = f"http://127.0.0.1:{listener.getsockname()[1]}"
        client = stack.enter_context(httpx.Client(base_url=address, timeout=60))
        environment = {name: value for name, value in os.environ.items() if not name.startswith("REGNF_")}
        environment |= objects.environment | {
            "REGNF_REDIS_URL": url,
            "REGNF_STORAGE_URL": f"s3://{objects.new_bucket()}/service",
            "REGNF_HEARTBEAT_S": "0.2",
        }
        made = House(tmp_path, redis, objects, environment, listener, client)
        try:
            yield made
        finally:
            objects.thaw()
            for process in made.processes:
                process.kill()
                process.wait()
