"""A private Redis a module, and the record stores that must keep the same promises."""

from collections.abc import Iterator

import pytest
from redis import Redis

from service.memory import InMemoryRecordStore
from service.records import RecordStore
from service.redis_client import connect
from service.redis_records import RedisRecordStore
from tests.redis_server import private_redis


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
