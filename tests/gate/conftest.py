"""Fixtures of the tests of bad input: sound files to spoil, and a house to bring them to."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from redis import Redis

from tests.core.importing.fuzzing.seeds import Seeds, make_seeds
from tests.gate.house import House, make_house


@pytest.fixture(scope="session")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Seeds:
    """A small checkpoint taken apart, and the field file it becomes."""
    return make_seeds(tmp_path_factory.mktemp("seeds"))


@pytest.fixture
def house(tmp_path: Path, any_redis: Redis, seeds: Seeds, monkeypatch: pytest.MonkeyPatch) -> Iterator[House]:
    """Ends with nothing left of what was refused, and with the next good upload taken."""
    monkeypatch.setattr(tempfile, "tempdir", None)  # put back afterwards: the house sets it
    made = make_house(tmp_path, any_redis, seeds.field_file)
    with made.world.client:
        yield made
        made.assert_nothing_left()
        made.assert_next_is_taken()
