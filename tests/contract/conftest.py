"""What the contract's tests share: services, a few bad bytes, and what must hold after a refusal."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from tests.contract.live import Live, eventually, live_service
from tests.contract.world import World, field_bytes, make_world, put, sha256


@pytest.fixture
def worlds(tmp_path: Path, any_redis: Redis) -> Iterator[Callable[..., World]]:
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


# common to the tests of refused uploads and requests: good input, a few bad bytes, and what must hold afterwards


GOOD = field_bytes("good")
PUT_GOOD = f"/fields/{sha256(GOOD)}"
TOO_LARGE = field_bytes("large", 4097)
PNG = b"\x89PNG\r\n\x1a\n" + b"\0" * 600


@pytest.fixture
def nothing_of_an_upload_stays(world: World) -> Iterator[None]:
    """No blob, no record; and the next good upload is taken."""
    yield
    assert world.blobs.blobs == {}
    assert world.records.list_fields(None, 10, None).records == []
    assert world.client.put(PUT_GOOD, content=GOOD).status_code == 201


@pytest.fixture
def nothing_of_a_request_stays(world: World) -> Iterator[None]:
    """No job, nothing queued; and the next good request is taken."""
    request = world.valid_request()
    yield
    assert world.records.list_jobs(None, 10, None).records == []
    assert world.queue.registrations == []
    assert world.client.post("/register", json=request).status_code == 202


def announced(data: bytes) -> str:
    return f"sha-256=:{base64.b64encode(bytes.fromhex(sha256(data))).decode()}:"


def post(world: World, body: Any, address: str = "/register", **headers: str) -> Any:
    # json.dumps writes NaN and Infinity, which httpx would not
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    return world.client.post(address, content=content, headers={"Content-Type": "application/json"} | headers)
