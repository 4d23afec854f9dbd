"""Every process refuses to start over a Redis that holds the records of another storage."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from regnf_state.journal.journal import STORAGE_KEY
from regnf_state.redis.client import connect
from tests.faults.house import plain_environment
from tests.redis_server import private_redis
from tests.worker.bench import eventually

SERVE = [sys.executable, "-m", "regnf_cli.main", "serve", "--port", "0", "--workers", "0"]
WORKER = [sys.executable, "-m", "regnf_worker.main"]
API = [sys.executable, "-c", "import socket; from regnf_cli.api_process import main; "
       "main(socket.create_server(('127.0.0.1', 0)).detach())"]  # fmt: skip


@pytest.fixture
def another_s() -> Iterator[str]:
    """A Redis of another storage."""
    with private_redis() as url, connect(url) as redis:
        redis.set(STORAGE_KEY, "0" * 32)
        yield url


@pytest.mark.parametrize("command", [SERVE, WORKER, API], ids=["serve", "worker", "api"])
def test_a_process_starts_over_another_storage_only_when_the_operator_names_it(
    another_s: str, tmp_path: Path, command: list[str]
) -> None:
    environment = plain_environment() | {"REGNF_REDIS_URL": another_s, "REGNF_STATE_DIR": str(tmp_path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    said = " ".join((done.stdout + done.stderr).split())
    storage_id = (tmp_path / "blobs/journal/storage-id").read_text()
    assert (done.returncode != 0, "STORAGE_MISMATCH" in said, storage_id in said) == (True, True, True), said
    with connect(another_s) as redis:
        assert redis.get(STORAGE_KEY) == b"0" * 32
        assert redis.keys("rq:*") == []
        if command is not WORKER:
            return
        process = subprocess.Popen(
            WORKER, env=environment | {"REGNF_ADOPT_STORAGE": storage_id}, stderr=subprocess.DEVNULL
        )
        try:
            eventually(lambda: redis.get(STORAGE_KEY) == storage_id.encode(), "the adoption")
            assert process.poll() is None
        finally:
            process.kill()
            process.wait()
