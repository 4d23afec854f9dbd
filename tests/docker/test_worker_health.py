"""The worker's health check against a real Redis and what workers report."""

from __future__ import annotations

import importlib.util
import socket
import subprocess
import sys
from types import ModuleType

import pytest
from redis import Redis

from regnf_state.redis.queue import JobQueue
from tests.docker.files import ROOT

SCRIPT = ROOT / "docker" / "worker_health.py"


@pytest.fixture(scope="module")
def health() -> ModuleType:
    spec = importlib.util.spec_from_file_location("worker_health", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_only_a_worker_of_this_host_that_reported_lately_is_alive(health: ModuleType, redis: Redis) -> None:
    queue = JobQueue(redis)
    queue.report("elsewhere:1")
    assert not health.is_alive(redis, "here")
    queue.report("here:1")
    assert health.is_alive(redis, "here")
    redis.zincrby("regnf:workers", -46, "here:1")
    assert not health.is_alive(redis, "here"), "it has stopped reporting"
    queue.report("here:1")
    queue.sign_off("here:1")
    assert not health.is_alive(redis, "here"), "it said goodbye"


@pytest.mark.parametrize(
    ("url", "said"), [(None, "set REGNF_REDIS_URL"), ("unix:///nowhere/socket", "Redis does not answer")]
)
def test_says_what_is_wrong(url: str | None, said: str) -> None:
    environment = {"PYTHONPATH": str(ROOT)} | ({"REGNF_REDIS_URL": url} if url else {})
    run = subprocess.run([sys.executable, SCRIPT], env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert said in run.stderr


def test_exit_status_follows_the_worker(redis_url: str, redis: Redis) -> None:
    environment = {"PYTHONPATH": str(ROOT), "REGNF_REDIS_URL": redis_url}
    run = subprocess.run([sys.executable, SCRIPT], env=environment, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (1, "no worker of this host has reported lately\n")
    JobQueue(redis).report(f"{socket.gethostname()}:1")
    run = subprocess.run([sys.executable, SCRIPT], env=environment, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")
