"""The worker's health check against a real Redis and the keys that RQ itself writes."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from types import ModuleType
from typing import Any

import pytest
from redis import Redis
from rq import Queue, Worker

from regnf_state.queue import QUEUE_NAME
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
    for name in ("elsewhere", "here"):
        assert not health.is_alive(redis, "here")
        worker: Any = Worker([Queue(QUEUE_NAME, connection=redis)], connection=redis, name=f"{name}-1")
        worker.hostname = name
        worker.register_birth()
    assert health.is_alive(redis, "here")
    assert redis.ttl(worker.key) > 0, "the registration runs out by itself"
    held = redis.hgetall(worker.key)
    redis.delete(worker.key)
    assert not health.is_alive(redis, "here"), "it has stopped reporting"
    redis.hset(worker.key, mapping=held)
    assert health.is_alive(redis, "here")
    worker.register_death()
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
    worker: Any = Worker([Queue(QUEUE_NAME, connection=redis)], connection=redis)
    worker.register_birth()
    run = subprocess.run([sys.executable, SCRIPT], env=environment, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")
