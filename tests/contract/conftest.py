"""Fixtures of the contract's tests: a service over stores in memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.contract.world import World, make_world


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    """A service with an upload limit of 4 KiB."""
    made = make_world(tmp_path)
    with made.client:
        yield made
