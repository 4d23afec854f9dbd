"""API and worker as two machines would run them: nothing between them but Redis and an object store."""

from __future__ import annotations

import hashlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import pytest

from benchmarks.service_load.small_fields import write_small_pair
from tests.live_stack import finished, imported
from tests.object_store import ObjectServer
from tests.redis_server import private_redis
from tests.worker.bench import eventually

PATIENCE_S = 300.0
"""Pictures follow with a low priority."""


@contextmanager
def process(module: list[str], environment: dict[str, str], log: Path, *passed: int) -> Iterator[None]:
    with log.open("wb") as file:
        started = subprocess.Popen([sys.executable, "-m", *module], env=environment, stderr=file, pass_fds=passed)
    try:
        yield
    finally:
        started.terminate()
        try:
            started.wait(20)
        except subprocess.TimeoutExpired:
            started.kill()
            started.wait()


@pytest.fixture
def client(tmp_path: Path, objects: ObjectServer) -> Iterator[httpx.Client]:
    """A client of the API; the worker's folder is `worker`, the API's `api`."""
    with ExitStack() as stack:
        url = stack.enter_context(private_redis())
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        plain = {name: value for name, value in os.environ.items() if not name.startswith("REGNF_")}
        shared = {
            "REGNF_REDIS_URL": url,
            "REGNF_STORAGE_URL": f"s3://{objects.new_bucket()}/two/hosts",
            "REGNF_DEVICE": "cpu",
            "REGNF_THREADS": "1",
        }
        for name, module in (
            ("api", ["regnf_cli.api_process", str(listener.fileno())]),
            ("worker", ["regnf_worker.main"]),
        ):
            environment = plain | shared | objects.environment | {"REGNF_STATE_DIR": str(tmp_path / name)}
            stack.enter_context(process(module, environment, tmp_path / f"{name}.log", listener.fileno()))
        address = f"http://127.0.0.1:{listener.getsockname()[1]}"
        made = stack.enter_context(httpx.Client(base_url=address, timeout=60))
        eventually(lambda: made.get("/readyz").status_code == 200, lambda: logs(tmp_path))
        yield made


def logs(folder: Path) -> str:
    return "\n".join(path.read_text() for path in folder.glob("*.log"))


@pytest.mark.long
def test_a_registration_between_two_machines(client: httpx.Client, tmp_path: Path) -> None:
    pair = write_small_pair(tmp_path)
    scene, object_ = (imported(client, path.read_bytes())["sha256"] for path in (pair.scene, pair.object))
    answer = client.post("/register", json={"scene": scene, "object": object_, "detection": pair.detection})
    assert answer.status_code == 202, answer.text
    job_id = answer.json()["id"]
    assert finished(client, job_id)["status"] == "successful", logs(tmp_path)
    result = client.get(f"/jobs/{job_id}/result").json()
    assert result["verdict"] == "registered"
    for one in result["artifacts"]:  # the answer waits a while for those that follow the result
        eventually(lambda of=one["url"]: client.get(of).status_code == 200, lambda: logs(tmp_path), PATIENCE_S)
    for artifact in client.get(f"/jobs/{job_id}/result").json()["artifacts"]:
        content = client.get(artifact["url"]).content
        assert hashlib.sha256(content).hexdigest() == artifact["sha256"]
        middle = len(content) // 2
        part = client.get(artifact["url"], headers={"Range": f"bytes={middle}-{middle + 9}"})
        assert (part.status_code, part.content) == (206, content[middle : middle + 10])
    picture = f"/fields/{scene}/preview.png"
    eventually(lambda: client.get(picture).content.startswith(b"\x89PNG"), lambda: logs(tmp_path), PATIENCE_S)
    assert len(list((tmp_path / "worker" / "field-cache").iterdir())) >= 2, "the fields stay with the worker"
    assert not (tmp_path / "api" / "blobs").exists()
    assert not (tmp_path / "worker" / "blobs").exists()
