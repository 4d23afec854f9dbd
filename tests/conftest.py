"""What every test shares."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.object_store import ObjectServer, object_server

# Threads of several processes that spin while they wait slow a shared machine tenfold. Set before torch loads.
os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture(scope="session")
def objects() -> Iterator[ObjectServer]:
    """An S3 server for all tests; each makes a bucket of its own."""
    with object_server() as server:
        yield server
