"""What every test shares."""

from __future__ import annotations

import tests.environment  # noqa: F401 -- first

# isort: split
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache

import pytest
from hypothesis import HealthCheck, settings
from redis import Redis

from regnf_state.redis.client import connect
from regnf_state.redis.jobs import RecordStore
from tests.grouping import pytest_collection_modifyitems
from tests.live_stack import demo_fields, live_client, live_stack
from tests.object_store import ObjectServer, object_server
from tests.redis_server import default_server, installed_servers, private_redis

# A busy machine is no finding: neither an example nor their generation is timed.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

__all__ = ["demo_fields", "live_client", "live_stack", "pytest_collection_modifyitems"]


@pytest.fixture(autouse=True)
def environment_as_before() -> Iterator[None]:
    """Commands run here set variables for the processes that they start; the next test knows nothing of them."""
    before = dict(os.environ)
    yield
    if os.environ != before:
        os.environ.clear()
        os.environ.update(before)


@pytest.fixture(scope="session")
def objects() -> Iterator[ObjectServer]:
    """An S3 server for all tests; each makes a bucket of its own."""
    with object_server() as server:
        yield server


@pytest.fixture(scope="session")
def redis_server() -> Iterator[Callable[[str], str]]:
    """The address of a server by its kind; each is started when it is first asked for."""
    with ExitStack() as stack:
        yield cache(lambda name: stack.enter_context(private_redis(name)))


@pytest.fixture(scope="session", params=installed_servers())
def redis_url(request: pytest.FixtureRequest, redis_server: Callable[[str], str]) -> str:
    """A server of each kind in turn."""
    return redis_server(request.param)


@pytest.fixture
def redis(redis_url: str) -> Iterator[Redis]:
    """Empty."""
    with connect(redis_url) as client:
        client.flushall()
        yield client


@pytest.fixture
def any_redis(redis_server: Callable[[str], str]) -> Iterator[Redis]:
    """Empty; for tests that are not about Redis itself, on one kind of server."""
    with connect(redis_server(default_server())) as client:
        client.flushall()
        yield client


@pytest.fixture
def store(redis: Redis) -> RecordStore:
    """A record store, empty."""
    return RecordStore(redis)
