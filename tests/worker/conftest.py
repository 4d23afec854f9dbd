"""What several of the worker's tests stand on."""

import time
from collections.abc import Iterator

import pytest

from tests.redis_server import private_redis
from tests.worker.refusals import RefusingRedis


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Nobody sleeps; the list says how long they would have slept."""
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    return slept


@pytest.fixture
def redis() -> Iterator[RefusingRedis]:
    with private_redis() as url, RefusingRedis.from_url(url) as client:
        yield client
