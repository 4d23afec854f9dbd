"""The worker's health check against a real Redis and the keys that RQ itself writes."""

from __future__ import annotations

import runpy
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest
from redis import Redis
from rq import Queue, Worker

from regnf_state.queue import QUEUE_NAME
from tests.docker.files import ROOT

SCRIPT = ROOT / "docker" / "worker_health.py"


@pytest.fixture(scope="module")
def health() -> SimpleNamespace:
    return SimpleNamespace(**runpy.run_path(str(SCRIPT)))


def test_a_worker_of_this_host_that_reports_is_alive(health: SimpleNamespace, redis: Redis) -> None:
    """Another host's does not count, nor one that said goodbye, or whose registration has run out."""
    workers = {}
    for host in ("here", "gone", "silent"):
        workers[host] = Worker([Queue(QUEUE_NAME, connection=redis)], connection=redis, name=f"{host}-1")
        workers[host].hostname = host
        workers[host].register_birth()
    assert [health.is_alive(redis, host) for host in ("here", "gone", "silent", "elsewhere")] == [True] * 3 + [False]
    workers["gone"].register_death()
    assert redis.ttl(workers["silent"].key) > 0
    redis.delete(workers["silent"].key)
    assert [health.is_alive(redis, host) for host in ("here", "gone", "silent")] == [True, False, False]


def checked(**variables: str) -> tuple[int, str]:
    environment = {"PYTHONPATH": str(ROOT)} | variables
    run = subprocess.run([sys.executable, SCRIPT], env=environment, capture_output=True, text=True, check=False)
    return run.returncode, run.stderr


def test_says_what_is_wrong() -> None:
    for variables, said in (({}, "set REGNF_REDIS_URL"), ({"REGNF_REDIS_URL": "unix:///no"}, "Redis does not answer")):
        status, printed = checked(**variables)
        assert (status, said in printed) == (1, True)


def test_exit_status_follows_the_worker(redis_url: str, redis: Redis) -> None:
    assert checked(REGNF_REDIS_URL=redis_url) == (1, "no worker of this host has reported lately\n")
    worker: Any = Worker([Queue(QUEUE_NAME, connection=redis)], connection=redis)
    worker.register_birth()
    assert checked(REGNF_REDIS_URL=redis_url) == (0, "")
