"""What several of the worker's tests stand on."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from redis import Redis

from regnf_state.settings import Settings
from regnf_worker.models import Context
from tests.worker.doubles import context_over
from tests.worker.refusals import RefusingRedis


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Nobody sleeps; the list says how long they would have slept."""
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    return slept


@pytest.fixture
def redis(redis_url: str) -> Iterator[RefusingRedis]:
    with RefusingRedis.from_url(redis_url) as client:
        client.flushall()
        yield client


@pytest.fixture
def context(tmp_path: Path, any_redis: Redis) -> Context:
    """Heartbeats that do not keep a test waiting."""
    return context_over(any_redis, Settings(state_dir=tmp_path, heartbeat_s=0.05))
