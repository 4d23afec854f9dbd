"""Fixtures of the contract's tests: a service over stores in memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from redis import Redis

from tests.contract.bad_input import nothing_of_a_request_stays, nothing_of_an_upload_stays
from tests.contract.world import World, make_world

__all__ = ["nothing_of_a_request_stays", "nothing_of_an_upload_stays", "world"]


@pytest.fixture
def world(tmp_path: Path, any_redis: Redis) -> Iterator[World]:
    """A service with an upload limit of 4 KiB."""
    made = make_world(tmp_path, any_redis)
    with made.client:
        yield made
