"""Fixtures of the contract's tests: a service over stores in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from redis import Redis

from tests.contract.bad_input import nothing_of_a_request_stays, nothing_of_an_upload_stays
from tests.contract.live import Live, eventually, live_service
from tests.contract.world import World, field_bytes, make_world, put

__all__ = ["nothing_of_a_request_stays", "nothing_of_an_upload_stays", "world"]


@pytest.fixture
def worlds(tmp_path: Path, any_redis: Redis) -> Iterator[Callable[..., World]]:
    """Makes services with settings of their own."""
    with ExitStack() as stack:

        def make(**settings: object) -> World:
            made = make_world(tmp_path, any_redis, **settings)
            stack.enter_context(made.client)
            return made

        yield make


@pytest.fixture
def world(worlds: Callable[..., World]) -> World:
    """A service with an upload limit of 4 KiB."""
    return worlds()


@pytest.fixture
def guarded(worlds: Callable[..., World]) -> World:
    """A service that asks for one of two tokens."""
    return worlds(api_tokens=frozenset({"first-token", "second-token"}))


@pytest.fixture(scope="session")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A real API without a worker, so that what was uploaded lies still. Its users are the group `live api`."""
    with live_service(tmp_path_factory.mktemp("live-api"), with_worker=False) as started:
        yield started


@pytest.fixture
def nothing_stays_live(live: Live) -> Iterator[None]:
    """The test ends with the store as empty as it began, and with the next good upload taken."""
    yield
    with live.client() as client:
        for field in client.get("/fields").json()["fields"]:
            client.delete(f"/fields/{field['sha256']}")
        eventually(lambda: live.files() == set(), "an empty store")
        good = field_bytes("the next good one")
        answer = put(client, good)
        assert answer.status_code == 201
        assert client.delete(answer.headers["location"]).status_code == 204
