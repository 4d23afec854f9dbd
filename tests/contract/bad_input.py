"""Common to the tests of refused uploads and requests: good input, a few bad bytes, and what must hold afterwards."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from typing import Any

import pytest

from tests.contract.world import World, field_bytes, sha256

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
    """The Content-Digest of these bytes."""
    return f"sha-256=:{base64.b64encode(bytes.fromhex(sha256(data))).decode()}:"


def post(world: World, body: Any, address: str = "/register", **headers: str) -> Any:
    """POST to an address that starts jobs, with a body that may be no JSON at all."""
    # json.dumps writes NaN and Infinity, which httpx would not
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    return world.client.post(address, content=content, headers={"Content-Type": "application/json"} | headers)
