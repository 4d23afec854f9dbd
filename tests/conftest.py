"""What every test shares."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from redis import Redis

from regnf_state.memory import InMemoryRecordStore
from regnf_state.records import RecordStore
from regnf_state.redis.client import connect
from regnf_state.redis.jobs import RedisRecordStore
from tests.object_store import ObjectServer, object_server
from tests.redis_server import private_redis

# Threads of several processes that spin while they wait slow a shared machine tenfold. Set before torch loads.
os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture(scope="session")
def objects() -> Iterator[ObjectServer]:
    """An S3 server for all tests; each makes a bucket of its own."""
    with object_server() as server:
        yield server


@pytest.fixture(scope="module")
def redis_url() -> Iterator[str]:
    with private_redis() as url:
        yield url


@pytest.fixture
def redis(redis_url: str) -> Iterator[Redis]:
    with connect(redis_url) as client:
        client.flushall()
        yield client


@pytest.fixture(params=["memory", "redis"])
def store(request: pytest.FixtureRequest) -> Iterator[RecordStore]:
    if request.param == "memory":
        yield InMemoryRecordStore()
        return
    yield RedisRecordStore(request.getfixturevalue("redis"))
